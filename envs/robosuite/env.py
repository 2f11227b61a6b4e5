"""robosuite's tasks as Gymnasium environments, with robomimic's low-dimensional observation."""

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_dtfm.envs.rendering import make_renderer
from sb3_dtfm.envs.robosuite.cameras import Cameras, camera_args
from sb3_dtfm.envs.robosuite.scene import CONTROL_FREQUENCY, import_robosuite, make_robosuite, scene_xml
from sb3_dtfm.envs.robosuite.sensors import Observer
from sb3_dtfm.envs.robosuite.tasks import TASKS


class RobosuiteEnv(gym.Env[Any, np.ndarray]):
    """
    A Panda arm on one of robosuite's tasks, moved by an OSC_POSE delta controller at 20 Hz.

    Actions (7,) lie in [-1, 1]: position change (1 is 0.05 m), rotation change as an axis-angle vector (1 is 0.5 rad),
    gripper (positive closes); Wipe's are (6,), for its wiper has no fingers. The reward is 1 at the step that solves the
    task, which terminates the episode with `info["is_success"]`, and 0 before; `horizon` truncates.

    Observations follow robomimic: `robot0_eef_pos` (3), `robot0_eef_quat` (4, x y z w), `robot0_gripper_qpos` (2), and
    robosuite 1.5's `object-state`; :attr:`observation_keys` has their widths. Lift, 19 in all: cube position (3), cube
    quaternion (4), gripper to cube (3). Can, 23 in all: can position (3) and quaternion (4) in the gripper's frame, then can
    position (3) and quaternion (4). All of them describe the state after the step. (robosuite's own `step` returns positions
    from before it, and its first relative poses of an episode are zeros; robomimic's files hold the state after the step.)

    Everything random comes from `np_random`, and an episode depends on nothing but its start:
    the same seed gives the same numbers in any process, whatever was run before.

    For `render_mode="rgb_array"` on a machine without display, set `MUJOCO_GL` to `egl` or `osmesa` beforehand.

    :param task: name of the task, a key of :data:`~sb3_dtfm.envs.robosuite.TASKS`
    :param horizon: steps after which an unsolved episode is truncated; the task's own, 400 for most, if not given
    :param render_mode: None, "rgb_array" or "human"
    :param controller_config: robosuite 1.5 composite controller, or a single-arm controller of robosuite <= 1.4;
        robosuite's default for the Panda if not given
    :param lite_physics: robosuite's faster stepping (one forward pass per physics step); same dynamics
    :param cameras: names of the observed cameras, such as "agentview" and "robot0_eye_in_hand": the observation is a Dict
        then, of their images and of the arm's own numbers, by robomimic's names
    :param camera_size: height and width of these images, pixels
    :param object_state: whether `object` is observed, too; by default only without cameras
    :param camera_name: camera of `rgb_array` frames
    :param width: width of `rgb_array` frames, pixels
    :param height: height of `rgb_array` frames, pixels
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": CONTROL_FREQUENCY}  # noqa: RUF012

    def __init__(
        self,
        task: str = "Lift",
        horizon: int | None = None,
        render_mode: str | None = None,
        controller_config: dict[str, Any] | None = None,
        lite_physics: bool = True,
        cameras: Sequence[str] = (),
        camera_size: int = 84,
        object_state: bool | None = None,
        camera_name: str = "agentview",
        width: int = 256,
        height: int = 256,
    ) -> None:
        if task not in TASKS:
            raise ValueError(f"task must be one of {', '.join(map(repr, TASKS))}, got {task!r}.")
        if render_mode not in (None, "rgb_array", "human"):
            raise ValueError(f"render_mode must be None, 'rgb_array' or 'human', got {render_mode!r}.")
        if horizon is not None and horizon < 1:
            raise ValueError(f"horizon must be at least 1, got {horizon}.")
        self.task = task
        self._row = TASKS[task]
        self.horizon = self._row.horizon if horizon is None else horizon
        self.render_mode = render_mode
        self.camera_name = camera_name
        self.width = width
        self.height = height
        self._env = make_robosuite(self._row.environment, controller_config, lite_physics)
        self._steps = 0
        self._renderer: Any = None
        self._viewer: Any = None
        self._find_references()
        low, high = self._env.action_spec
        self._low, self._high = low.astype(np.float32), high.astype(np.float32)
        self.action_space = spaces.Box(self._low, self._high, dtype=np.float32)
        self._start_from(self.state)
        self._observer = Observer(self._env)
        self._camera_size = camera_size
        self._cameras = Cameras(self._env.sim.model._model, cameras, camera_size) if cameras else None
        self._draws_images = True
        hidden = {"object"} if object_state is False or (cameras and not object_state) else set()
        self._keys = {key: width for key, width in self._observer.keys.items() if key not in hidden}
        vectors = {key: spaces.Box(-np.inf, np.inf, (width,), np.float32) for key, width in self._keys.items()}
        self.observation_space: spaces.Space[Any] = spaces.Box(-np.inf, np.inf, (sum(self._keys.values()),), np.float32)
        if self._cameras is not None:
            self.observation_space = spaces.Dict({**self._cameras.space, **vectors})

    @property
    def state(self) -> np.ndarray:
        """MuJoCo's time, qpos and qvel, (1 + nq + nv,) float64: what robomimic calls `states`."""
        return np.asarray(self._env.sim.get_state().flatten())

    @property
    def observation_keys(self) -> dict[str, int]:
        """robomimic's names of what an observation holds, in order, and how many numbers each has."""
        return dict(self._observer.keys)

    @property
    def model_file(self) -> str:
        """MuJoCo XML of the present episode's scene; asset paths start at robosuite's package, as robomimic expects."""
        return scene_xml(self._env, self._row.variation)

    @property
    def env_args(self) -> dict[str, Any]:
        """This environment as robomimic files describe theirs."""
        return {
            "env_name": self._row.environment,
            "env_version": import_robosuite().__version__,
            "type": 1,
            "env_kwargs": {
                "robots": ["Panda"],
                "controller_configs": self._env.robots[0].composite_controller_config,
                "control_freq": CONTROL_FREQUENCY,
                "lite_physics": bool(self._env.lite_physics),
                "reward_shaping": False,
                "has_renderer": False,
                "has_offscreen_renderer": False,
                "ignore_done": True,
                "use_object_obs": True,
                **camera_args(self._cameras.names if self._cameras is not None else (), self._camera_size),
            },
        }

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """
        Draw a new start, or take a recorded one.

        :param seed: restarts the environment's random stream; without it the stream continues
        :param options: `{"state": ...}` starts from a recorded :attr:`state`, with none of Wipe's dirt wiped; `"model_file"`
            beside it brings what was recorded of the scene: the size of Lift's cube, the place of the door or of the dirt
        :return: observation and `{"is_success": False}`
        """
        super().reset(seed=seed)
        self._steps = 0
        if options is not None and "state" in options:
            self._restore(np.asarray(options["state"], np.float64), options.get("model_file"))
        else:
            self._draw()
        if self.render_mode == "human":
            self.render()
        return self._observe(), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """
        Move for 0.05 s.

        :param action: (A,) in [-1, 1]
        :return: observation, reward (0 or 1), terminated (solved), truncated (horizon), `{"is_success": ...}`
        :raises ValueError: wrong shape, NaN or infinity
        """
        # Through float32 always: a recorded action, stored in whichever precision, then replays to the bit.
        command = np.asarray(action, np.float32).astype(np.float64)
        if command.shape != self._low.shape or not np.isfinite(command).all():
            raise ValueError(f"action must be {self._low.shape} finite numbers, got {action!r}.")
        self._advance(np.clip(command, self._low, self._high))
        self._steps += 1
        success = self._row.is_solved(self._env)
        truncated = not success and self._steps >= self.horizon
        if self.render_mode == "human":
            self.render()
        return self._observe(self._draws_images), float(success), success, truncated, {"is_success": success}

    def draw_images(self, wanted: bool) -> None:
        """
        Choose whether the next steps draw what cameras see, which takes most of a step. For a caller who does not look.

        :param wanted: whether they draw; otherwise steps return the images that were drawn last; a reset draws always
        """
        self._draws_images = wanted

    def render(self) -> np.ndarray | None:
        """
        The scene as an (height, width, 3) uint8 image for "rgb_array"; shown in MuJoCo's viewer for "human".
        """
        import mujoco

        if self.render_mode is None:
            gym.logger.warn("render() needs a render_mode: pass 'rgb_array' or 'human' when making the environment.")
            return None
        model, data = self._env.sim.model._model, self._env.sim.data._data
        if self.render_mode == "human":
            if self._viewer is None:
                import mujoco.viewer

                self._viewer = mujoco.viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False)
                self._viewer.opt.geomgroup[0] = 0  # collision shapes
            self._viewer.sync()
            return None
        if self._renderer is None:
            self._renderer = make_renderer(model, self.height, self.width)
            self._scene_option = mujoco.MjvOption()
            self._scene_option.geomgroup[0] = 0  # collision shapes
        self._renderer.update_scene(data, camera=self.camera_name, scene_option=self._scene_option)
        return np.asarray(self._renderer.render())

    def close(self) -> None:
        """Free the renderer, the viewer and the simulation."""
        for name in ("_renderer", "_viewer", "_cameras"):
            if getattr(self, name, None) is not None:
                getattr(self, name).close()
                setattr(self, name, None)
        if getattr(self, "_env", None) is not None:
            self._env.close()
            self._env = None

    def _observe(self, draw: bool = True) -> Any:
        """The present observation: (O,) float32, or by key where cameras see it."""
        seen = self._observer()
        if self._cameras is None:
            return seen[: sum(self._keys.values())]  # the object's part comes last
        parts = np.split(seen, np.cumsum(list(self._observer.keys.values()))[:-1])
        vectors = {key: part for key, part in zip(self._observer.keys, parts, strict=True) if key in self._keys}
        images = self._cameras(self._env.sim.data._data) if draw else self._cameras.images
        return {**images, **vectors}

    def _find_references(self) -> None:
        env, robot = self._env, self._env.robots[0]
        model = env.sim.model
        self._n_substeps = round(env.control_timestep / env.model_timestep)
        self._actuators = {
            part: (indexes, model.actuator_ctrlrange[indexes, 0].copy(), model.actuator_ctrlrange[indexes, 1].copy())
            for part, indexes in robot._ref_actuators_indexes_dict.items()
        }

    def _draw(self) -> None:
        """Start an episode at random."""
        # All that draws in robosuite shares one generator, which goes on where Gymnasium's stands.
        rng = self._env.rng
        rng.bit_generator.state = self.np_random.bit_generator.state
        if self._row.variation is not None:
            self._row.variation.draw(self._env, rng)
        self._env.reset()
        self.np_random.bit_generator.state = rng.bit_generator.state
        self._start_from(self.state)

    def _restore(self, state: np.ndarray, model_file: str | None) -> None:
        """
        Start an episode from where a recorded one was.

        :param state: (1 + nq + nv,)
        :param model_file: MuJoCo XML of its scene; the present one if not given
        """
        variation = self._row.variation
        scene = None if variation is None else ET.fromstring(model_file or self.model_file)
        self._env.reset()  # forgets what the task remembers, such as the dirt that is gone
        if variation is not None and scene is not None:
            variation.read(self._env, scene)
        self._start_from(state)

    def _start_from(self, state: np.ndarray) -> None:
        """
        Start an episode in a state, with nothing left over of what was simulated before.

        :param state: (1 + nq + nv,)
        """
        sim, robot = self._env.sim, self._env.robots[0]
        expected = (1 + sim.model.nq + sim.model.nv,)
        if state.shape != expected:
            raise ValueError(f"state has shape {state.shape}, expected {expected} for {self.task}.")
        sim.reset()
        sim.set_state_from_flattened(state)
        sim.forward()
        # Resets the controllers and remembers the present joints as the posture to keep; a robosuite reset proper would
        # also draw noise.
        nominal_joints = robot.init_qpos
        robot.init_qpos = sim.data.qpos[robot._ref_joint_pos_indexes].copy()
        robot.reset(deterministic=True)
        robot.init_qpos = nominal_joints
        sim.forward()

    def _advance(self, action: np.ndarray) -> None:
        """
        robosuite's own step, less the bookkeeping that nothing here reads; the trajectories are the same to the bit.

        :param action: (A,) float64
        """
        import mujoco

        sim, robot = self._env.sim, self._env.robots[0]
        lite_physics, controller = self._env.lite_physics, robot.composite_controller
        ctrl = sim.data.ctrl
        for substep in range(self._n_substeps):
            sim.step1() if lite_physics else sim.forward()
            if substep == 0:
                controller.update_state()
                controller.set_goal(action)
            for part, control in controller.run_controller(robot._enabled_parts).items():
                indexes, low, high = self._actuators[part]
                ctrl[indexes] = np.clip(control, low, high)
            sim.step2() if lite_physics else sim.step()
        mujoco.mj_kinematics(sim.model._model, sim.data._data)
