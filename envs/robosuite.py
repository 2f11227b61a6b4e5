"""robosuite's Lift and Can tasks as Gymnasium environments, with robomimic's low-dimensional observation."""

import json
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_dtfm.envs.robosuite_scene import (
    CONTROL_FREQUENCY,
    CUBE_SIZE_RANGE,
    TASKS,
    cube_size,
    import_robosuite,
    make_robosuite,
    scene_xml,
    set_cube_size,
)


def register_robosuite_envs() -> None:
    """
    Make `gymnasium.make("robosuite/Lift-v0")` and `"robosuite/Can-v0"` work. Repeated calls change nothing.

    No `max_episode_steps` is registered: the horizon is the environment's own argument.
    """
    for task in TASKS:
        env_id = f"robosuite/{task}-v0"
        if env_id not in gym.registry:
            gym.register(env_id, entry_point="sb3_dtfm.envs.robosuite:RobosuiteEnv", kwargs={"task": task})


def env_kwargs_from_robomimic(env_args: str | dict[str, Any]) -> dict[str, Any]:
    """
    Arguments of :class:`RobosuiteEnv` that describe the environment of a robomimic file.

    :param env_args: the `env_args` attribute of the file's `data` group, of robosuite 1.4 or 1.5
    :return: `task`, `controller_config` and `lite_physics`
    :raises ValueError: a task, robot or control frequency other than this module's
    """
    arguments: dict[str, Any] = json.loads(env_args) if isinstance(env_args, str) else env_args
    kwargs = arguments.get("env_kwargs", {})
    tasks = {robosuite_name: task for task, robosuite_name in TASKS.items()}
    name = arguments.get("env_name")
    if name not in tasks:
        raise ValueError(f"env_name is {name!r}; supported are {', '.join(map(repr, tasks))}.")
    robots = kwargs.get("robots", "Panda")
    if robots not in ("Panda", ["Panda"]):
        raise ValueError(f"robots is {robots!r}; only a single 'Panda' is supported.")
    frequency = kwargs.get("control_freq", CONTROL_FREQUENCY)
    if frequency != CONTROL_FREQUENCY:
        raise ValueError(f"control_freq is {frequency!r}; only {CONTROL_FREQUENCY} is supported.")
    config = kwargs.get("controller_configs")
    if isinstance(config, list):
        config = config[0]
    return {"task": tasks[name], "controller_config": config, "lite_physics": kwargs.get("lite_physics", True)}


class RobosuiteEnv(gym.Env[np.ndarray, np.ndarray]):
    """
    A Panda arm on robosuite's Lift or Can task, moved by an OSC_POSE delta controller at 20 Hz.

    Actions (7,) lie in [-1, 1]: position change (1 is 0.05 m), rotation change as an axis-angle vector (1 is 0.5 rad),
    gripper (positive closes). The reward is 1 at the step that solves the task, which terminates the episode with
    `info["is_success"]`, and 0 before; `horizon` truncates.

    Observations follow robomimic: `robot0_eef_pos` (3), `robot0_eef_quat` (4, x y z w), `robot0_gripper_qpos` (2), and
    robosuite 1.5's `object-state`. Lift, 19 in all: cube position (3), cube quaternion (4), gripper to cube (3). Can, 23 in
    all: can position (3) and quaternion (4) in the gripper's frame, then can position (3) and quaternion (4). All of them
    describe the state after the step. (robosuite's own `step` returns positions from before it, and its first Can
    observation of an episode holds zeros; robomimic's files hold the state after the step.)

    Everything random comes from `np_random`, the cube's size included, and an episode depends on nothing but its start:
    the same seed gives the same numbers in any process, whatever was run before.

    For `render_mode="rgb_array"` on a machine without display, set `MUJOCO_GL` to `egl` or `osmesa` beforehand.

    :param task: "Lift" or "Can"
    :param horizon: steps after which an unsolved episode is truncated
    :param render_mode: None, "rgb_array" or "human"
    :param controller_config: robosuite 1.5 composite controller, or a single-arm controller of robosuite <= 1.4;
        robosuite's default for the Panda if not given
    :param lite_physics: robosuite's faster stepping (one forward pass per physics step); same dynamics
    :param camera_name: camera of `rgb_array` frames
    :param width: of `rgb_array` frames, pixels
    :param height: of `rgb_array` frames, pixels
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": CONTROL_FREQUENCY}  # noqa: RUF012

    def __init__(
        self,
        task: str = "Lift",
        horizon: int = 400,
        render_mode: str | None = None,
        controller_config: dict[str, Any] | None = None,
        lite_physics: bool = True,
        camera_name: str = "agentview",
        width: int = 256,
        height: int = 256,
    ) -> None:
        if task not in TASKS:
            raise ValueError(f"task must be one of {', '.join(map(repr, TASKS))}, got {task!r}.")
        if render_mode not in (None, "rgb_array", "human"):
            raise ValueError(f"render_mode must be None, 'rgb_array' or 'human', got {render_mode!r}.")
        if horizon < 1:
            raise ValueError(f"horizon must be at least 1, got {horizon}.")
        self.task = task
        self.horizon = horizon
        self.render_mode = render_mode
        self.camera_name = camera_name
        self.width = width
        self.height = height
        self._env = make_robosuite(task, controller_config, lite_physics)
        self._steps = 0
        self._renderer: Any = None
        self._viewer: Any = None
        self._find_references()
        low, high = self._env.action_spec
        self._low, self._high = low.astype(np.float32), high.astype(np.float32)
        self.action_space = spaces.Box(self._low, self._high, dtype=np.float32)
        self._start_from(self.state)
        self.observation_space = spaces.Box(-np.inf, np.inf, self._observation().shape, np.float32)

    @property
    def state(self) -> np.ndarray:
        """MuJoCo's time, qpos and qvel, (1 + nq + nv,) float64: what robomimic calls `states`."""
        return np.asarray(self._env.sim.get_state().flatten())

    @property
    def model_file(self) -> str:
        """MuJoCo XML of the scene with the present cube; asset paths start at robosuite's package, as robomimic expects."""
        return scene_xml(self._env)

    @property
    def env_args(self) -> dict[str, Any]:
        """This environment as robomimic files describe theirs."""
        return {
            "env_name": TASKS[self.task],
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
                "use_camera_obs": False,
                "camera_depths": False,
            },
        }

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """
        Draw a new start, or take a recorded one.

        :param seed: restarts the environment's random stream; without it the stream goes on
        :param options: `{"state": ...}` starts from a recorded :attr:`state`; `"model_file"` beside it brings the cube it
            was recorded with
        :return: observation and `{"is_success": False}`
        """
        super().reset(seed=seed)
        self._steps = 0
        if options is not None and "state" in options:
            if self.task == "Lift" and options.get("model_file") is not None:
                set_cube_size(self._env, cube_size(options["model_file"]))
            self._start_from(np.asarray(options["state"], np.float64))
        else:
            if self.task == "Lift":
                set_cube_size(self._env, self.np_random.uniform(*CUBE_SIZE_RANGE, size=3))
            self._env.rng = self.np_random
            for sampler in self._placement_samplers:
                sampler.rng = self.np_random
            self._env.reset()
            self._start_from(self.state)
        if self.render_mode == "human":
            self.render()
        return self._observation(), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        Move for 0.05 s.

        :param action: (7,) in [-1, 1]
        :return: observation, reward (0 or 1), terminated (solved), truncated (horizon), `{"is_success": ...}`
        :raises ValueError: wrong shape, NaN or infinity
        """
        # Through float32 always: a recorded action, stored in whichever precision, then replays to the bit.
        command = np.asarray(action, np.float32).astype(np.float64)
        if command.shape != self._low.shape or not np.isfinite(command).all():
            raise ValueError(f"action must be {self._low.shape} finite numbers, got {action!r}.")
        self._advance(np.clip(command, self._low, self._high))
        self._steps += 1
        success = bool(self._env._check_success())
        truncated = not success and self._steps >= self.horizon
        if self.render_mode == "human":
            self.render()
        return self._observation(), float(success), success, truncated, {"is_success": success}

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
            self._renderer = mujoco.Renderer(model, self.height, self.width)
            self._scene_option = mujoco.MjvOption()
            self._scene_option.geomgroup[0] = 0  # collision shapes
        self._renderer.update_scene(data, camera=self.camera_name, scene_option=self._scene_option)
        return np.asarray(self._renderer.render())

    def close(self) -> None:
        """Free the renderer, the viewer and the simulation."""
        for name in ("_renderer", "_viewer"):
            if getattr(self, name, None) is not None:
                getattr(self, name).close()
                setattr(self, name, None)
        if getattr(self, "_env", None) is not None:
            self._env.close()
            self._env = None

    def _find_references(self) -> None:
        env, robot = self._env, self._env.robots[0]
        model, arm = env.sim.model, robot.arms[0]
        self._n_substeps = round(env.control_timestep / env.model_timestep)
        self._eef_site = robot.eef_site_id[arm]
        self._hand_body = model.body_name2id(robot.robot_model.eef_name[arm])
        self._gripper_qpos = np.asarray(robot._ref_gripper_joint_pos_indexes[arm])
        self._object_body = env.cube_body_id if self.task == "Lift" else env.obj_body_id["Can"]
        self._actuators = {
            part: (indexes, model.actuator_ctrlrange[indexes, 0].copy(), model.actuator_ctrlrange[indexes, 1].copy())
            for part, indexes in robot._ref_actuators_indexes_dict.items()
        }
        placement = env.placement_initializer
        self._placement_samplers = [placement, *getattr(placement, "samplers", {}).values()]

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

        :param action: (7,) float64
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

    def _observation(self) -> np.ndarray:
        """(19,) or (23,) float32, from MuJoCo's present positions."""
        import robosuite.utils.transform_utils as transforms

        data = self._env.sim.data
        eef_position = data.site_xpos[self._eef_site]
        eef_quaternion = transforms.convert_quat(data.body_xquat[self._hand_body], to="xyzw")
        position = data.body_xpos[self._object_body]
        quaternion = transforms.convert_quat(data.body_xquat[self._object_body], to="xyzw")
        if self.task == "Lift":
            object_state = [position, quaternion, position - eef_position]
        else:
            world_in_gripper = transforms.pose_inv(transforms.pose2mat((eef_position, eef_quaternion)))
            pose = transforms.pose2mat((position, quaternion))
            relative = transforms.mat2pose(transforms.pose_in_A_to_pose_in_B(pose, world_in_gripper))
            object_state = [*relative, position, quaternion]
        gripper = data.qpos[self._gripper_qpos]
        return np.concatenate([eef_position, eef_quaternion, gripper, *object_state]).astype(np.float32)
