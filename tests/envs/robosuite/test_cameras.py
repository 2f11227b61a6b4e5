"""Recorded images are the observed ones, pixel by pixel, upright, and beside the arm's own numbers."""

import ctypes.util

import pytest

from tests.envs.robosuite.conftest import run_python

BACKEND = next((name for library, name in (("EGL", "egl"), ("OSMesa", "osmesa")) if ctypes.util.find_library(library)), None)
pytestmark = pytest.mark.skipif(BACKEND is None, reason="needs EGL or OSMesa")

SEEN = """
import shlex
import gymnasium, h5py, mujoco, numpy as np, sb3_dtfm.envs
from sb3_dtfm.cli.inspect import command, load
from sb3_dtfm.data import load_dataset
from sb3_dtfm.data.inspection import inspect_buffer
from sb3_dtfm.envs import ReturnToGoWrapper
from sb3_dtfm.cli.main import main
cameras = ["agentview", "robot0_eye_in_hand"]
assert not main(["record", "--demonstrator", "lift", "--camera", *cameras, "--camera-size", "48", "--episodes", "2",
                 "--output", "lift.hdf5"])
env = gymnasium.make("robosuite/Lift-v0", cameras=cameras, camera_size=48)
flags = env.unwrapped._cameras._renderer.scene.flags
assert not any(flags[flag] for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION))
keys = ["agentview_image", "robot0_eye_in_hand_image", "robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos"]
print(list(env.observation_space))
buffer = load_dataset("lift.hdf5", observation_keys=keys)
print(*shlex.split(command(["lift.hdf5"], [], [], buffer, inspect_buffer(buffer)))[-3:])
shown = {"cameras": cameras, "camera_size": 48}
print(*load("lift.hdf5", {"observation_keys": keys}, "robosuite/Lift-v0", shown).image_spaces)
wrapped = ReturnToGoWrapper(env, 1.0)
with h5py.File("lift.hdf5") as file:
    demo = file["data/demo_0"]
    for step in (0, 20):
        options = {"state": demo["states"][step], "model_file": demo.attrs["model_file"]}
        seen, _ = wrapped.reset(options=options)
        for key in keys[:2]:
            assert np.array_equal(seen[key], buffer.own(key)[step].numpy()), (key, step)
        np.testing.assert_allclose(seen["observation"], buffer.observations[step].numpy(), atol=1e-6)
first = buffer.own(keys[0])[0].float().numpy()
red = first[..., 0] - first[..., 1:].mean(axis=2)
print(int(np.argmax(red.max(axis=1)) > 16), "the cube lies below the arm")
try:
    gymnasium.make("robosuite/Lift-v0", cameras=["nowhere"])
except ValueError as error:
    print(str(error)[:60])

from sb3_dtfm import DTFM
from sb3_dtfm.benchmark import evaluation
from sb3_dtfm.envs.cameras import images_on_demand
from sb3_dtfm.envs.robosuite.cameras import Cameras
wrappers = [{"sb3_dtfm.envs.ReturnToGoWrapper": {"target_return": 1.0}}]
class Unknown(gymnasium.Wrapper):
    pass
draw, drawn = Cameras.__call__, []
Cameras.__call__ = lambda self, data: drawn.append(1) or draw(self, data)
def made(wrappers, n_envs):
    settings = {"env_wrapper": wrappers, "env_kwargs": {"cameras": cameras, "camera_size": 48, "horizon": 6}}
    return evaluation.make_seeded_envs("robosuite/Lift-v0", settings, n_envs)
def count(model, envs, as_needed=True):
    # images drawn in three episodes, and what was done in them
    envs.reset()
    acted = []
    class Told:
        policy = model.policy if as_needed else None
        def predict(self, *args, **kwargs):
            actions, state = model.predict(*args, **kwargs)
            acted.append(actions)
            return actions, state
    drawn.clear()
    episodes = evaluation.evaluate(Told(), envs, [3, 4, 5])
    assert all(env.unwrapped._draws_images for env in envs.envs)
    return len(drawn), episodes.lengths, hash(np.stack(acted).tobytes())
def learned(context_length):
    return DTFM("MultiInputPolicy", wrapped, "lift.hdf5", dataset_kwargs={"observation_keys": keys},
                context_length=context_length, policy_kwargs={"chunk_size": 8, "n_action_steps": 4})
one, two = learned(1), learned(2)
wrapped.close()
two_envs, watched = made(wrappers, 2), made(["__main__.Unknown", *wrappers], 1)
print(count(one, two_envs, as_needed=False) + count(one, two_envs))
print(count(two, two_envs)[0], count(one, watched)[0])
drawn.clear()
try:
    with images_on_demand(two_envs) as choose:
        choose(np.zeros(2, bool))
        two_envs.envs[0].unwrapped.step(np.zeros(7))
        raise KeyboardInterrupt
except KeyboardInterrupt:
    print(len(drawn), [env.unwrapped._draws_images for env in two_envs.envs])
watched.close()
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from sb3_dtfm.zoo.comparison import N_RANDOM_EPISODES, MeasureRandomActions
lift = make_vec_env("robosuite/Lift-v0", env_kwargs={"cameras": cameras, "camera_size": 48, "horizon": 6},
                    wrapper_class=ReturnToGoWrapper, wrapper_kwargs={"target_return": 1.0})
random = MeasureRandomActions([EvalCallback(lift)], seed=0)
random.model = one
drawn.clear()
random._on_training_start()
print(len(drawn) - N_RANDOM_EPISODES, one.return_reference.random, lift.envs[0].unwrapped._draws_images)
lift.close()
two_envs.close()
"""


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """Lines that the program prints; its start takes as long as all that it does."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("cameras"))
        result = run_python(SEEN, MUJOCO_GL=BACKEND)
    assert result.returncode == 0, result.stderr
    return result.stdout.splitlines()[-9:]


def test_recorded_images_are_the_observed_ones(told):
    keys = ["agentview_image", "robot0_eef_pos", "robot0_eef_quat", "robot0_eye_in_hand_image", "robot0_gripper_qpos"]
    below = "1 the cube lies below the arm"
    unknown = "cameras: there is no nowhere; accepted are frontview, birdvi"
    seen = ["agentview_image", "robot0_eye_in_hand_image"]
    arguments = "--env-kwargs cameras:['agentview', 'robot0_eye_in_hand'] camera_size:48"
    assert told[:5] == [str(keys), arguments, " ".join(seen), below, unknown]


def test_an_evaluation_draws_what_the_policy_looks_at_and_is_the_same(told):
    n_all, lengths, actions, n_needed, lengths_again, actions_again = eval(told[5])  # tuples of numbers
    assert (lengths_again, actions_again) == (lengths, actions)
    # Three episodes of six steps: their starts, and each step or the one with which a new chunk begins.
    assert (n_all, n_needed) == (3 + 3 * 6, 3 + 3)
    assert lengths == [6, 6, 6]


def test_images_are_drawn_where_anyone_may_look(told):
    assert told[6] == "21 21"  # a longer context, and an unknown wrapper
    assert told[7] == "0 [True, True]"  # after an exception


def test_random_actions_are_measured_without_drawing_but_at_starts(told):
    assert told[8] == "1 0.0 True"  # the start after the last episode
