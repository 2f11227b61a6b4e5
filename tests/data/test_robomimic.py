"""robomimic files in the layouts of robosuite 1.4.1 and 1.5, written by hand: what is read, and what is refused."""

import json
import os
import re

import h5py
import numpy as np
import pytest
from gymnasium import spaces

from sb3_dtfm.data import load_dataset
from sb3_dtfm.data.robomimic import load_robomimic
from sb3_dtfm.data.trajectories import DatasetError
from tests.data import corpus

ROBOT = {"robot0_eef_pos": 3, "robot0_eef_quat": 4, "robot0_gripper_qpos": 2}
OLD_CONTROLLER = {"type": "OSC_POSE", "input_max": 1, "input_min": -1, "control_delta": True, "kp": 150}
NEW_CONTROLLER = {
    "type": "BASIC",
    "body_parts": {"right": {"type": "OSC_POSE", "input_max": 1, "input_min": -1, "input_type": "delta"}},
}


def env_args(name="Lift", version="1.5.1", **kwargs):
    controller = OLD_CONTROLLER if version < "1.5" else NEW_CONTROLLER
    common = {"robots": ["Panda"], "control_freq": 20, "controller_configs": controller, "reward_shaping": False}
    return {"env_name": name, "env_version": version, "type": 1, "env_kwargs": {**common, **kwargs}}


def make_demo(n_steps, success_at=None, seed=0, object_width=10):
    """One demonstration as robomimic stores it: rewarded from the first success on, done there and at the end."""
    rng = np.random.default_rng(seed)
    rewards = np.zeros(n_steps)
    if success_at is not None:
        rewards[success_at:] = 1.0
    dones = rewards.astype(np.int64)
    dones[-1] = 1
    observations = {key: rng.normal(size=(n_steps, width)) for key, width in ROBOT.items()}
    observations["object"] = rng.normal(size=(n_steps, object_width))
    observations["robot0_joint_pos"] = rng.normal(size=(n_steps, 7))
    return {"obs": observations, "actions": rng.uniform(-1, 1, (n_steps, 7)), "rewards": rewards, "dones": dones}


def write(path, demos, arguments=None, masks=None):
    """The layout of robomimic's own files; `demos` maps names to what `make_demo` returns."""
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["total"] = sum(len(demo["actions"]) for demo in demos.values())
        data.attrs["env_args"] = json.dumps(arguments or env_args(), indent=4)
        for name, demo in demos.items():
            group = data.create_group(name)
            group.attrs["num_samples"] = len(demo["actions"])
            group.attrs["model_file"] = "<mujoco/>"
            group["states"] = np.zeros((len(demo["actions"]), 32))
            for key, values in demo.items():
                if key == "obs":
                    for observation, array in values.items():
                        group[f"obs/{observation}"] = array
                        group[f"next_obs/{observation}"] = np.roll(array, -1, axis=0)
                else:
                    group[key] = values
        for key, names in (masks or {}).items():
            file[f"mask/{key}"] = names
    return path


def stacked(demo, keys=(*ROBOT, "object")):
    return np.concatenate([demo["obs"][key] for key in keys], axis=1).astype(np.float32)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "demos.hdf5"


@pytest.mark.parametrize("version", ["1.4.1", "1.5.1"])
def test_both_layouts_are_read(path, version):
    demos = {f"demo_{i}": make_demo(6 + i, success_at=5 + i, seed=i) for i in range(3)}
    buffer = load_robomimic(write(path, demos, env_args(version=version)))
    assert buffer.episode_lengths.tolist() == [6, 7, 8]
    np.testing.assert_array_equal(buffer.observations, np.concatenate([stacked(demo) for demo in demos.values()]))
    actions = np.concatenate([demo["actions"] for demo in demos.values()]).astype(np.float32)
    np.testing.assert_array_equal(buffer.actions, actions)
    assert buffer.action_space.low.tolist() == [-1.0] * 7
    assert buffer.action_space.high.tolist() == [1.0] * 7
    assert buffer.source == str(path)


def test_demonstrations_come_in_numerical_order(path):
    demos = {f"demo_{i}": make_demo(i + 1, success_at=i) for i in (10, 2, 0, 1)}
    assert load_robomimic(write(path, demos)).episode_lengths.tolist() == [1, 2, 3, 11]


def test_episode_ends_at_its_first_success(path):
    demos = {"demo_0": make_demo(20, success_at=12), "demo_1": make_demo(9, success_at=8)}
    buffer = load_robomimic(write(path, demos))
    assert buffer.episode_lengths.tolist() == [13, 9]
    assert buffer.episode_returns.tolist() == [1.0, 1.0]
    assert buffer.rewards.nonzero().flatten().tolist() == [12, 21]
    assert buffer.terminated.tolist() == [True, True]
    assert buffer.truncated.tolist() == [False, False]


def test_failed_episode_is_truncated_and_a_broken_off_one_is_neither(path):
    broken_off = make_demo(5)
    broken_off["dones"][:] = 0
    demos = {"demo_0": make_demo(5, success_at=4), "demo_1": make_demo(7), "demo_2": broken_off}
    buffer = load_robomimic(write(path, demos))
    assert buffer.episode_returns.tolist() == [1.0, 0.0, 0.0]
    assert buffer.terminated.tolist() == [True, False, False]
    assert buffer.truncated.tolist() == [False, True, False]


@pytest.mark.parametrize("stored", ["zeros", "nothing"])
def test_without_rewards_the_first_done_step_is_the_success(path, stored):
    demos = {"demo_0": make_demo(8, success_at=5), "demo_1": make_demo(4)}
    for demo in demos.values():
        if stored == "zeros":
            demo["rewards"][:] = 0.0
        else:
            del demo["rewards"]
    told = "there is no reward but 0" if stored == "zeros" else "there are no rewards"
    with pytest.warns(UserWarning, match=f"demos.hdf5: {told}, nor any success, so that every episode counts as a success"):
        buffer = load_robomimic(write(path, demos))
    assert buffer.episode_lengths.tolist() == [6, 4]
    assert buffer.episode_returns.tolist() == [1.0, 1.0]
    assert buffer.terminated.all()


def test_without_rewards_and_dones_the_last_step_is_the_success(path):
    demo = make_demo(6)
    del demo["rewards"], demo["dones"]
    buffer = load_robomimic(write(path, {"demo_0": demo}))
    assert buffer.rewards.tolist() == [0.0] * 5 + [1.0]


def test_dense_rewards_are_kept(path):
    demo = make_demo(4, success_at=2)
    demo["rewards"] = np.array([0.125, 0.5, 1.0, 1.0])
    buffer = load_robomimic(write(path, {"demo_0": demo}, env_args(reward_shaping=True)))
    assert buffer.rewards.tolist() == [0.125, 0.5, 1.0, 1.0]
    assert (buffer.terminated.tolist(), buffer.successes.tolist()) == ([True], [1.0])


OWN = {"env_name": "MyEnv-v0", "type": 2, "env_kwargs": {}}


@pytest.mark.parametrize("rewards", [[5.0, 5.0], [0.0, 0.9], [-1.0, 0.0], [1.0, 1.0]])
def test_dense_rewards_tell_of_no_success(rewards, path):
    write(path, {"demo_0": {**make_demo(2), "rewards": np.array(rewards)}}, OWN)
    buffer = load_dataset(path)
    assert buffer.rewards.tolist() == pytest.approx(rewards)
    assert np.isnan(buffer.successes).all()
    with pytest.raises(DatasetError, match=r"of 1 of 1 episodes the data do not tell whether they succeeded"):
        load_dataset(path, success_only=True)


def test_a_demonstration_that_begins_with_success_leaves_the_others_alone(path):
    demos = {"demo_0": make_demo(5, success_at=2), "demo_1": {**make_demo(3), "rewards": np.ones(3)}}
    buffer = load_robomimic(write(path, demos))
    assert buffer.episode_lengths.tolist() == [3, 1]
    assert buffer.terminated.all()


@pytest.mark.parametrize("dtype", ["S", "O"])
def test_filter_key_selects(path, dtype):
    demos = {f"demo_{i}": make_demo(i + 1, success_at=i) for i in range(12)}
    names = np.array(["demo_10", "demo_2", "demo_4"], dtype=dtype)
    write(path, demos, masks={"train": names, "valid": np.array(["demo_1"], dtype="S")})
    assert load_robomimic(path, filter_key="train").episode_lengths.tolist() == [3, 5, 11]
    assert load_robomimic(path).n_episodes == 12


OF_NUMBERS = {"some chunks unwritten", "a cut szip chunk", "a cut scaleoffset chunk"}  # which names cannot be


@pytest.mark.parametrize("what", sorted({name for name, (_, right) in corpus.HDF5.items() if right is None} - OF_NUMBERS))
def test_a_bad_mask_is_refused_as_a_bad_array_is(what, path):
    names = np.array(["demo_0", "demo_1"] * 4, "S")
    write(path, {f"demo_{i}": make_demo(3, success_at=2) for i in range(2)}, masks={"train": names})
    with h5py.File(path, "r+") as file:
        corpus.HDF5[what][0](file, "mask/train", path.parent)
    with corpus.time_limit(), pytest.raises(DatasetError, match=r"mask|filter key"):
        load_robomimic(path, filter_key="train")


def test_observation_keys_are_chosen_in_order(path):
    demo = make_demo(5, success_at=4)
    keys = ("robot0_joint_pos", "robot0_eef_pos")
    buffer = load_robomimic(write(path, {"demo_0": demo}), observation_keys=keys)
    np.testing.assert_array_equal(buffer.observations, stacked(demo, keys))


@pytest.mark.parametrize(("stored", "asked"), [("object-state", "object"), ("object", "object-state")])
def test_object_state_has_two_names(path, stored, asked):
    demo = make_demo(5, success_at=4)
    expected = stacked(demo)
    demo["obs"][stored] = demo["obs"].pop("object")
    buffer = load_robomimic(write(path, {"demo_0": demo}), observation_keys=(*ROBOT, asked))
    np.testing.assert_array_equal(buffer.observations, expected)


def test_old_lift_files_get_the_present_sign(path):
    demo = make_demo(5, success_at=4)
    observations = demo["obs"]
    observations["object"][:, 7:] = observations["robot0_eef_pos"] - observations["object"][:, :3]
    read = load_robomimic(write(path, {"demo_0": demo}, env_args(version="1.4.1"))).observations
    np.testing.assert_allclose(read[:, 16:], read[:, 9:12] - read[:, :3], atol=1e-6)
    kept = load_robomimic(write(path, {"demo_0": demo}, env_args(version="1.5.1"))).observations
    np.testing.assert_array_equal(kept, stacked(demo))


@pytest.mark.parametrize("task", ["PickPlaceCan", "PickPlaceMilk", "NutAssemblySquare"])
def test_old_files_of_one_object_get_the_present_order(task, path):
    demo = make_demo(5, success_at=4, object_width=14)
    observations, state = demo["obs"], demo["obs"]["object"]
    quarter_turn = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])  # the hand's x axis is the world's y axis
    observations["robot0_eef_quat"][:] = quarter_turn
    away = state[:, :3] - observations["robot0_eef_pos"]
    state[:, 7:10] = np.stack([away[:, 1], -away[:, 0], away[:, 2]], axis=1)
    read = load_robomimic(write(path, {"demo_0": demo}, env_args(task, "1.4.1"))).observations
    np.testing.assert_array_equal(read[:, 9:], np.concatenate([state[:, 7:], state[:, :7]], axis=1).astype(np.float32))
    kept = load_robomimic(write(path, {"demo_0": demo}, env_args(task, "1.5.1"))).observations
    np.testing.assert_array_equal(kept, stacked(demo))


def test_wider_controller_inputs_widen_the_action_space(path):
    demo = make_demo(5, success_at=4)
    demo["actions"][:, 0] = 1.5
    controller = {**OLD_CONTROLLER, "input_max": 2, "input_min": -2}
    buffer = load_robomimic(write(path, {"demo_0": demo}, env_args(controller_configs=controller)))
    assert buffer.action_space.high.tolist() == [2.0] * 6 + [1.0]


def refused(path, **arguments):
    with pytest.raises(DatasetError) as caught:
        load_robomimic(path, **arguments)
    assert str(path) in str(caught.value)
    return str(caught.value)


def test_missing_file_is_named(path):
    assert "does not exist" in refused(path)


def test_other_kinds_of_file_are_named(path):
    path.write_text("no hdf5")
    assert "not an hdf5 file" in refused(path)


@pytest.mark.parametrize("share", [0.3, 0.9, 0.999])
def test_cut_off_file_is_named(path, share):
    write(path, {f"demo_{i}": make_demo(50, success_at=49) for i in range(5)})
    os.truncate(path, int(share * path.stat().st_size))
    assert "cut off" in refused(path)


def test_file_without_data_is_named(path):
    with h5py.File(path, "w") as file:
        file["episodes"] = np.zeros(3)
    assert "has no group 'data', only 'episodes'" in refused(path)


def test_file_without_demonstrations_is_named(path):
    assert "holds no demonstration" in refused(write(path, {}))


def test_unknown_filter_key_lists_the_known(path):
    write(path, {"demo_0": make_demo(3)}, masks={"train": np.array([b"demo_0"]), "valid": np.array([b"demo_0"])})
    assert "has no filter key 'test'; available: 'train', 'valid'" in refused(path, filter_key="test")


def test_filter_key_of_absent_demonstrations_is_named(path):
    write(path, {"demo_0": make_demo(3)}, masks={"train": np.array([b"demo_7"]), "none": np.array([], dtype="S6")})
    assert "'train' lists 'demo_7', which is not in" in refused(path, filter_key="train")
    assert "'none' lists no demonstration" in refused(path, filter_key="none")


def test_unknown_observation_key_lists_the_known(path):
    write(path, {"demo_0": make_demo(3)})
    message = refused(path, observation_keys=["agentview_image"])
    assert "demo_0: has no observation 'agentview_image'; available: 'object', 'robot0_eef_pos'" in message


def test_demonstration_without_observations_is_named(path):
    demo = make_demo(3)
    demo["obs"] = {}
    assert "demo_0: has no group 'obs'" in refused(write(path, {"demo_0": demo}))


def change(name, value):
    def apply(demo):
        demo[name] = value(demo[name])

    return apply


def spoil(name, step, column, value):
    def apply(demo):
        array = demo["obs"][name] if name in demo["obs"] else demo[name]
        array[step, column] = value

    return apply


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (change("actions", lambda a: a[:, 0]), "demo_1: actions have shape (6,), expected (steps, dimensions)"),
        (change("actions", lambda a: a[:0]), "demo_1: actions have shape (0, 7)"),
        (change("actions", lambda a: a[:, :5]), "demo_1: actions have shape (6, 5), expected (6, 7)"),
        (change("rewards", lambda r: r[:4]), "demo_1: rewards have shape (4,), expected (6,)"),
        (change("dones", lambda d: d[:4]), "demo_1: dones have shape (4,), expected (6,)"),
        (
            change("obs", lambda o: {**o, "object": o["object"][:3]}),
            "demo_1: observation 'object' is float64 of shape (3, 10), expected (6, dimensions)",
        ),
        (
            change("obs", lambda o: {**o, "object": np.zeros((6, 8, 8, 3))}),
            "demo_1: observation 'object' is float64 of shape (6, 8, 8, 3), expected (6, dimensions)",
        ),
        (
            change("obs", lambda o: {**o, "object": o["object"][:, :3]}),
            "demo_1: observations have shape (6, 12), expected (6, 19)",
        ),
        (spoil("object", 2, 4, np.nan), "demo_1, step 2: observations hold nan, dimension 13; numbers must be finite"),
        (spoil("actions", 3, 1, np.inf), "demo_1, step 3: actions hold inf"),
        (spoil("actions", 3, 1, 1.7), "demo_1, step 3: action 1.7 in dimension 1 lies outside of the action space [-1, 1]"),
    ],
)
def test_damaged_demonstration_is_named(path, damage, message):
    demos = {"demo_0": make_demo(6, success_at=5), "demo_1": make_demo(6, success_at=5)}
    damage(demos["demo_1"])
    assert message in refused(write(path, demos))


def test_demonstration_without_actions_is_named(path):
    demo = make_demo(3)
    write(path, {"demo_0": demo})
    with h5py.File(path, "a") as file:
        del file["data/demo_0/actions"]
    assert "demo_0: has no 'actions', only 'dones'" in refused(path)


def test_nan_reward_is_named(path):
    demo = make_demo(6, success_at=5)
    demo["rewards"][2] = np.nan
    assert "demo_0, step 2: rewards hold nan" in refused(write(path, {"demo_0": demo}))


@pytest.mark.parametrize("controller", [{"control_delta": False}, {"input_type": "absolute"}])
def test_absolute_actions_are_refused(path, controller):
    write(path, {"demo_0": make_demo(3)}, env_args(controller_configs={**OLD_CONTROLLER, **controller}))
    assert "only files with a delta controller are accepted" in refused(path)


@pytest.mark.parametrize(
    ("name", "env_id"), [("Lift", "robosuite/Lift-v0"), ("PickPlaceCan", "robosuite/Can-v0"), ("NoSuchTask", None)]
)
def test_the_environment_is_the_registered_one_of_the_file_s_task(path, name, env_id):
    assert load_robomimic(write(path, {"demo_0": make_demo(3)}, env_args(name))).env_id == env_id


OTHERWISE = {
    "kp": ({"kp": 300}, {}, "kp is 300 instead of 150"),
    "output_max": ({"output_max": [0.025] * 3 + [0.25] * 3}, {}, r"output_max is \[0.025, .* instead of \[0.05, "),
    "type": ({"type": "JOINT_VELOCITY"}, {}, "type is 'JOINT_VELOCITY' instead of 'OSC_POSE'"),
    "damping": ({"damping": 2}, {}, "damping_ratio is 2 instead of 1"),
    "control_freq": ({}, {"control_freq": 10}, "control_freq is 10 instead of 20"),
    "robots": ({}, {"robots": ["Sawyer"]}, r"robots is \['Sawyer'\] instead of 'Panda'"),
}


@pytest.mark.parametrize("version", ["1.4.1", "1.5.1"])
@pytest.mark.parametrize(("arm", "kwargs", "message"), OTHERWISE.values(), ids=OTHERWISE)
def test_actions_that_move_the_arm_otherwise_are_refused(path, arm, kwargs, message, version):
    arm = {**OLD_CONTROLLER, **arm}
    controller = arm if version < "1.5" else {"type": "BASIC", "body_parts": {"right": arm}}
    write(path, {"demo_0": make_demo(3)}, env_args("Lift", version, controller_configs=controller, **kwargs))
    found = refused(path)
    assert re.search(f"an action does something else than in robosuite/Lift-v0: {message}", found), found
    assert load_dataset(path, env_id="My/Lift-v0").env_id == "My/Lift-v0"


def test_actions_outside_of_the_controllers_range_can_be_clipped(path):
    demo = make_demo(3)
    demo["actions"][0, 0] = 1.5
    write(path, {"demo_0": demo})
    assert "action 1.5 in dimension 0" in refused(path)
    assert load_robomimic(path, clip_actions=True).actions.max() == 1.0


def test_the_range_of_others_environments_is_given(path, tmp_path):
    demo = make_demo(3)
    demo["actions"] = np.linspace(-90, 90, 21).reshape(3, 7)
    write(path, {"demo_0": demo}, OWN)
    assert re.search(r"action -90 .*outside of .*\[-1, 1\]. This range is the default. Give .*action_bounds", refused(path))
    given = {"action_bounds": (-90, 90)}, {"action_space": spaces.Box(-90, 90, (7,))}
    for options in [*given, *({**each, "cache_dir": tmp_path / "cache"} for each in given)]:
        buffer = load_dataset(path, **options)
        assert (buffer.action_space.low.tolist(), buffer.action_space.high.tolist()) == ([-90.0] * 7, [90.0] * 7)
        np.testing.assert_array_equal(buffer.actions, demo["actions"].astype(np.float32))


def test_the_range_of_robosuites_controllers_is_the_files(path):
    write(path, {"demo_0": make_demo(3)})
    assert "action_bounds is (-90, 90); robosuite's controller, which" in refused(path, action_bounds=(-90, 90))
    assert load_dataset(path, action_space=spaces.Box(-90, 90, (7,))).action_space.high.tolist() == [1.0] * 7


def test_a_file_that_names_no_environment_is_read(path):
    write(path, {"demo_0": make_demo(3)})
    with h5py.File(path, "a") as file:
        del file["data"].attrs["env_args"]
    assert load_robomimic(path).env_id is None


def test_broken_env_args_are_named(path):
    write(path, {"demo_0": make_demo(3)})
    with h5py.File(path, "a") as file:
        file["data"].attrs["env_args"] = "{"
    assert "'env_args' of group 'data' is not JSON" in refused(path)


def test_cameras_are_chosen_beside_numbers(tmp_path):
    """As robomimic's image files hold them, a camera an entry of `obs`."""
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (n, 6, 8, 3), dtype=np.uint8) for n in (3, 4)]
    with h5py.File(tmp_path / "image.hdf5", "w") as file:
        for i, array in enumerate(images):
            demo = file.create_group(f"data/demo_{i}")
            demo["actions"], demo["obs/agentview_image"] = np.zeros((len(array), 2)), array
            demo["obs/robot0_eef_pos"] = rng.normal(size=(len(array), 3))
            demo["rewards"], demo["dones"] = np.eye(1, len(array), len(array) - 1)[0], np.zeros(len(array))
    buffer = load_robomimic(tmp_path / "image.hdf5", observation_keys=["agentview_image", "robot0_eef_pos"])
    np.testing.assert_array_equal(buffer.own("agentview_image").numpy(), np.concatenate(images))
    assert buffer.observations.shape == (7, 3)
    named = load_robomimic(
        tmp_path / "image.hdf5", observation_keys={"pixels": "agentview_image", "agent_pos": "robot0_eef_pos"}
    )
    assert set(named.image_spaces) == {"pixels"}
    np.testing.assert_array_equal(named.observations, buffer.observations)
    with h5py.File(tmp_path / "image.hdf5", "a") as file:
        del file["data/demo_1/obs/agentview_image"]
        file["data/demo_1/obs/agentview_image"] = images[1].astype(np.float32) / 255
    with pytest.raises(DatasetError, match=r"demo_1: observation 'agentview_image' is float32 .*uint8 images \(4, height"):
        load_robomimic(tmp_path / "image.hdf5", observation_keys=["agentview_image", "robot0_eef_pos"])
