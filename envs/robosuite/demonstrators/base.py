"""Base of all demonstrators: a manner, the way to the object, the grasp, and an unsteady hand."""

import numpy as np

from sb3_dtfm.envs.robosuite.demonstrators.rotations import DOWNWARD, rotation_between

# Action units per unit of error: one unit of action settles at 0.306 m/s and 3.06 rad/s (stiffness 150, critically damped).
METRES_PER_SECOND = 0.306
RADIANS_PER_SECOND = 3.06

TURN_SHARE = np.array([1.0, 1.0, 1.0, 0.3, 0.3, 0.3])  # of the unsteadiness, per action dimension

OPEN, CLOSE = -1.0, 1.0
FUNNEL_RADIUS = 0.008  # metres aside of the grasp point within which the descent goes straight down
FUNNEL_SLOPE = 2.0  # metres up for each metre further aside
OVERREACH = 0.012  # metres below the grasp point that the descent aims at, so that the hand does not creep the last bit
GRASP_TOLERANCE = 0.015  # metres from the grasp point, horizontally: the opened fingers leave 0.019 beside a cube
MISJUDGEMENT_RATE = 0.07  # of episodes whose first grasp closes on air, which shows how to begin again
FINGERS_OPEN = 0.03  # metres from the middle
FINGERS_STILL = 4e-4  # metres per step


class Manner:
    """
    One person's manner of doing one episode, drawn at random.

    :param rng: source of randomness
    :param speed_range: smallest and largest `speed` to draw, action units
    """

    def __init__(self, rng: np.random.Generator, speed_range: tuple[float, float]) -> None:
        self.speed = rng.uniform(*speed_range)  # largest action magnitude of a free movement
        self.time_constant = rng.uniform(0.15, 0.26)  # of the final approach to a point, seconds
        self.agility = rng.uniform(0.2, 0.4)  # largest change of an action from step to step
        self.hover_height = rng.uniform(0.05, 0.09)  # above the object, metres
        self.hover_tolerance = rng.uniform(0.015, 0.025)  # horizontal distance at which the descent starts, metres
        self.hover_offset = rng.normal(0.0, 0.006, 2)  # where the hover point lies beside the object, metres
        self.grasp_offset = rng.normal(0.0, (0.005, 0.005, 0.003))  # of the grasp point from the object's centre, metres
        self.grasp_height_tolerance = rng.uniform(0.006, 0.01)  # above the grasp point where the fingers close, metres
        self.dwell = int(rng.integers(0, 3))  # steps between fingers at rest and the lift
        self.lift_drift = rng.normal(0.0, 0.1, 2)  # sideways share of the lift's direction
        self.carry_height = rng.uniform(0.02, 0.06)  # of the object above what it has to pass over, metres
        self.release_offset = rng.normal(0.0, 0.01, 2)  # of the place of release from the middle of the goal, metres
        self.release_tolerance = rng.uniform(0.035, 0.055)  # from that place where the fingers open, metres
        self.noise = rng.uniform(0.05, 0.13)  # standard deviation of the unsteadiness of the hand, action units
        self.noise_memory = rng.uniform(0.7, 0.9)  # its correlation from step to step
        self.jerk_rate = rng.uniform(0.0, 0.06)  # how often the hand is jerked aside, per step


class Demonstrator:
    """
    Hover above the object, descend, grasp; what follows is the task's.

    It sees the observation alone, and acts through OSC_POSE.

    A grasp that closes on nothing, or an object lost on the way, leads back to the hover point.

    :param seed: seed of everything random; the same seed and observations give the same actions
    :param pause: steps that the hand rests before it closes, on average and after a first one; 0 closes at once. People
        hesitate, and nothing tells for how long
    """

    object_columns = slice(9, 12)  # where the observation holds the object's position
    smallest_grip = 0.012  # metres from the middle to a finger: closed further, it holds nothing
    grasp_height = 0.0  # metres above the object's centre
    misjudgement = 0.04  # metres too high where a first grasp goes wrong
    speed_range = (0.35, 0.7)
    turn_speed = 0.2  # largest action magnitude of a turn
    turn_tolerance = np.inf  # radians from the orientation of the grasp at which the descent may start
    free_stages = ("hover", "descend")  # where a jerk does no harm

    def __init__(self, seed: int | np.random.SeedSequence | None = None, pause: float = 0.0) -> None:
        self._rng = np.random.default_rng(seed)
        self._pause = pause
        self.reset()

    def reset(self) -> None:
        """Start another episode in another manner."""
        self.manner = Manner(self._rng, self.speed_range)
        self.stage = "hover"
        self._steps_in_stage = 0
        self._movement = np.zeros(6)
        self._unsteadiness = np.zeros(6)
        misjudges = self._rng.random() < MISJUDGEMENT_RATE
        self._misjudged_height = self.misjudgement * self._rng.uniform(0.8, 1.2) if misjudges else 0.0
        self._jerk = np.zeros(6)
        self._jerk_steps = 0
        self._fingers = 0.0
        self._orientation = DOWNWARD  # that the hand should take, x y z w
        self._to_turn = 0.0  # radians

    def act(self, observation: np.ndarray) -> np.ndarray:
        """
        The next action.

        :param observation: (O,) observation of the task
        :return: (7,) float32 in [-1, 1]
        """
        observation = np.asarray(observation, np.float64)
        hand = observation[:3]
        fingers = float(observation[7] - observation[8]) / 2.0
        finger_speed, self._fingers = abs(fingers - self._fingers), fingers
        position = self._locate(observation)
        turn = rotation_between(observation[3:7], self._orientation)
        self._to_turn = float(np.linalg.norm(turn))
        stage = self._next_stage(hand, position, fingers, finger_speed)
        self._steps_in_stage = self._steps_in_stage + 1 if stage == self.stage else 0
        self.stage = stage
        target, gripper = self._target(hand, position)
        return self._move(target - hand, turn, gripper)

    def _locate(self, observation: np.ndarray) -> np.ndarray:
        """
        Return where to grasp or hold the object, (3,) metres; the hand's orientation is chosen here too, where it matters.

        :param observation: (O,) float64
        """
        return observation[self.object_columns]

    def _next_stage(self, hand: np.ndarray, position: np.ndarray, fingers: float, finger_speed: float) -> str:
        manner = self.manner
        to_grasp = self._grasp_point(position) - hand
        aside = float(np.hypot(*to_grasp[:2]))
        if self.stage == "hover":
            above = aside < manner.hover_tolerance + float(np.hypot(*manner.hover_offset))
            ready = fingers > FINGERS_OPEN and self._to_turn < self.turn_tolerance
            return "descend" if above and ready else "hover"
        if self.stage == "descend":
            if aside > 0.04:
                return "hover"
            if aside < GRASP_TOLERANCE and -to_grasp[2] < manner.grasp_height_tolerance:
                return "pause" if self._pause > 0.0 else "grasp"
        if self.stage == "pause":  # as likely to end at any step: a geometric number of them
            return "pause" if self._rng.random() < self._pause / (self._pause + 1.0) else "grasp"
        if self.stage == "grasp" and self._steps_in_stage >= 3 + manner.dwell and finger_speed < FINGERS_STILL:
            self._misjudged_height = 0.0
            return self._after_grasp() if fingers > self.smallest_grip else "hover"
        if self.stage not in ("hover", "descend", "pause", "grasp"):
            return self._next_stage_holding(hand, position, fingers)
        return self.stage

    def _target(self, hand: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, float]:
        """Goal of the hand, (3,) metres, and the gripper's command."""
        grasp_point = self._grasp_point(position)
        aside = float(np.hypot(*(grasp_point - hand)[:2]))
        if self.stage == "hover":
            # Comes down on a slope, so that the hand arrives over the object and at hover height together.
            height = self.manner.hover_height + 0.5 * aside
            return grasp_point + np.array([*self.manner.hover_offset, height]), OPEN
        if self.stage == "descend":
            # Through a funnel: the further aside, the higher, so that the fingers come down beside the object, not on it.
            height = FUNNEL_SLOPE * max(aside - FUNNEL_RADIUS, 0.0) - OVERREACH
            return grasp_point + np.array([0.0, 0.0, height]), OPEN
        if self.stage in ("pause", "grasp"):
            return grasp_point, OPEN if self.stage == "pause" else CLOSE
        return self._target_holding(hand, position)

    def _grasp_point(self, position: np.ndarray) -> np.ndarray:
        return position + self.manner.grasp_offset + np.array([0.0, 0.0, self.grasp_height + self._misjudged_height])

    def _after_grasp(self) -> str:
        raise NotImplementedError

    def _next_stage_holding(self, hand: np.ndarray, position: np.ndarray, fingers: float) -> str:
        raise NotImplementedError

    def _target_holding(self, hand: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, float]:
        raise NotImplementedError

    def _move(self, offset: np.ndarray, rotation: np.ndarray, gripper: float) -> np.ndarray:
        """
        Return the action that moves towards a pose, smoothly and with an unsteady hand.

        :param offset: (3,) metres to go
        :param rotation: (3,) axis-angle to turn, radians
        :param gripper: command of the gripper
        """
        manner = self.manner
        wanted = np.empty(6)
        wanted[:3] = offset / (METRES_PER_SECOND * manner.time_constant)
        wanted[:3] *= min(1.0, manner.speed / max(float(np.linalg.norm(wanted[:3])), 1e-9))
        wanted[3:] = np.clip(rotation / (RADIANS_PER_SECOND * 1.5 * manner.time_constant), -self.turn_speed, self.turn_speed)
        self._movement += np.clip(wanted - self._movement, -manner.agility, manner.agility)
        # A hand in motion shakes more than one that aims, and turns less than it shifts.
        effort = 0.3 + 0.7 * float(np.linalg.norm(self._movement[:3])) / manner.speed
        fresh = np.sqrt(1.0 - manner.noise_memory**2) * self._rng.normal(size=6)
        self._unsteadiness = manner.noise_memory * self._unsteadiness + fresh
        noise = manner.noise * effort * TURN_SHARE * self._unsteadiness + self._next_jerk()
        action = np.append(self._movement + noise, gripper)
        return np.clip(action, -1.0, 1.0).astype(np.float32)

    def _next_jerk(self) -> np.ndarray:
        """
        A short push in a random direction now and then, which the steps after it correct.

        Unlike steady noise it leads far from the straight way and leaves most of the recorded actions clean.
        """
        if self._jerk_steps > 0:
            self._jerk_steps -= 1
            return self._jerk
        if self.stage in self.free_stages and self._rng.random() < self.manner.jerk_rate:
            direction = self._rng.normal(size=6)
            direction /= np.linalg.norm(direction[:3])
            self._jerk = self._rng.uniform(0.3, 1.0) * np.array([1.0, 1.0, 1.0, 0.4, 0.4, 0.4]) * direction
            self._jerk_steps = int(self._rng.integers(1, 4))
            return self._jerk
        return np.zeros(6)
