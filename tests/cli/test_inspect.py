"""Inspection of datasets: real recordings, and arrays of which every fault is known."""

import shlex
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from matplotlib.axes import Axes
from PIL import Image

import sb3_dtfm
from sb3_dtfm.cli.main import main
from sb3_dtfm.data import TrajectoryBuffer, load_dataset
from sb3_dtfm.data.inspection import inspect_buffer
from sb3_dtfm.zoo.arguments import train_arguments
from tests.recorded import DATASET_ID


def arrays(n_episodes=30, n_steps=4):
    """Observations are normal numbers, actions use half of the range, returns are 0 to 29."""
    rng = np.random.default_rng(0)
    n = n_episodes * n_steps
    return {
        "observations": rng.normal(size=(n, 3)), "actions": rng.uniform(-0.5, 0.5, (n, 2)),
        "rewards": np.repeat(np.arange(n_episodes) / n_steps, n_steps),
        "episode_lengths": [n_steps] * n_episodes, "terminals": np.arange(1, n + 1) % n_steps == 0,
    }  # fmt: skip


def test_numbers_of_good_data_and_nothing_to_remark():
    given = arrays()
    found = inspect_buffer(load_dataset(given))
    assert found.remarks == []
    assert found.target_return == 28.0  # the mean of 27, 28 and 29
    assert found.at_bounds == 0.0
    np.testing.assert_allclose(found.actions.high, given["actions"].max(axis=0), rtol=1e-6)
    np.testing.assert_allclose(found.observations.std, given["observations"].std(axis=0), rtol=1e-6)


def test_every_fault_is_remarked():
    given = arrays(12)
    given["observations"][:, 1] = 7.0
    given["observations"] = np.hstack([given["observations"], np.zeros((48, 1))])
    given["actions"][:, 0] = 0.0
    given["actions"][:, 1] *= 0.01
    given["rewards"][:] = 0.0
    given["terminals"][-1] = False
    for name in ("observations", "actions"):
        given[name][4:8] = given[name][:4]
    remarks = inspect_buffer(load_dataset(given)).remarks
    assert remarks == [
        "There are 12 episodes: what is learned depends on which ones.",
        "Stored twice: 1 episode of 12.",
        "Neither terminated nor truncated, the recording just stops: 1 episode of 12.",
        "No episode has any return, so a target return has no effect.",
        "Observations never change in dimensions 1, 3.",
        "Actions never change in dimension 0.",
        "Actions use less than 10% of the action space's range in dimension 1: is it the range of these data?",
    ]
    far = arrays(3_000)
    far["observations"][5, 2], far["actions"] = 1e6, np.sign(far["actions"])
    far["rewards"][:] = 1.0
    assert inspect_buffer(load_dataset(far)).remarks == [
        "All returns are 4: the policy copies the data, whatever its target return.",
        "Observations go far out in dimension 2: in 2, 110 standard deviations from the mean.",
        "100% of the actions are at a bound.",
    ]


def test_where_the_start_decides_the_command_asks_for_the_mean(workplace, capsys):
    given = arrays()
    given["observations"][::4, 0] = np.arange(30)
    np.savez("starts.npz", **given)
    assert main(["inspect", "starts.npz"]) == 0
    text = capsys.readouterr().out
    assert "- Returns depend on how an episode starts (9" in text
    assert "% of their variance): the best returns come from the easiest starts.\n" in text
    assert "--target-return 14.5\n" in text


def test_the_command_shows_a_table_a_picture_and_a_command_that_trains(workplace, capsys):
    assert main(["inspect", DATASET_ID, "-o", "figures/found.png"]) == 0
    text = capsys.readouterr().out
    rows = dict(
        line.strip("| ").split(" | ", 1)
        for line in text.splitlines()
        if line.startswith("| ")
        if not line.startswith("| Minari")
    )
    assert rows["task"] == "HalfCheetah-v5"
    assert rows["episodes"] == "3: 0 terminated, 3 truncated, 0 just stop"
    assert rows["steps"].startswith("3,000; an episode has 1,000 to 1,000, 1,000 in the median")
    assert (workplace / "figures" / "found.png").stat().st_size > 10_000
    command = shlex.split(text.split("To begin with:\n")[1].splitlines()[0])
    assert command[:2] == ["sb3-dtfm", "train"]
    assert main([*command[1:], "-n", "2", "--eval-freq", "-1", "--verbose", "0"]) == 0


def test_options_of_the_reader_and_several_datasets(workplace, capsys):
    np.savez("a.npz", **arrays())
    np.savez("b.npz", **arrays(5))
    assert main(["inspect", "a.npz", "b.npz", "--dataset-kwargs", "min_return:2"]) == 0
    text = capsys.readouterr().out
    assert "| episodes | 31: 31 terminated" in text
    command = text.split("To begin with:\n")[1].splitlines()[0]
    assert "--env TASK" in command
    given = train_arguments(shlex.split(command.replace("TASK", "Pendulum-v1"))[2:])
    assert "dataset_kwargs:dict(min_return=2)" in given
    assert "dataset:['a.npz', 'b.npz']" in given
    assert main(["inspect", "none.npz"]) == 2
    assert "none.npz does not exist" in capsys.readouterr().err


def test_what_lies_behind_the_task_s_time_limit_is_not_counted(workplace, capsys):
    np.savez("long.npz", **arrays(n_episodes=5, n_steps=250), env_id="Pendulum-v1")  # ends after 200 steps
    with pytest.warns(UserWarning, match="5 of 5 episodes have more than 200 steps"):
        assert main(["inspect", "long.npz"]) == 0
    text = capsys.readouterr().out
    assert "| steps | 1,000; an episode has 200 to 200" in text
    assert "best: 0, 0.32, 1.6, 2.88, 3.2 |" in text
    assert "--target-return 3.2" in text
    with pytest.warns(UserWarning, match="5 of 5 episodes"):
        assert main(["inspect", "long.npz", "--dataset-kwargs", "min_return:3"]) == 0
    assert "| episodes | 1: " in capsys.readouterr().out, "of 250 steps three episodes had such a return"
    assert main(["inspect", "long.npz", "--dataset-kwargs", "max_episode_steps:None"]) == 0
    assert "an episode has 250 to 250" in capsys.readouterr().out


def loaded(text: str) -> TrajectoryBuffer:
    """Read the dataset by the lines that are printed."""
    *before, last = text.split("To load it in Python:\n")[1].split("\n\n")[0].splitlines()
    names = {"gymnasium": gymnasium, "sb3_dtfm": sb3_dtfm}
    exec("\n".join(line.strip() for line in before), names)
    return eval(last.strip(), names)


class Floors(gymnasium.Env):
    """A Dict with a Discrete part, and a size that is an argument."""

    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, n_floors: int = 2) -> None:
        parts = {"floor": gymnasium.spaces.Discrete(n_floors), "speed": gymnasium.spaces.Box(-9.0, 9.0, (2,))}
        self.observation_space = gymnasium.spaces.Dict(parts)


def test_the_lines_that_load_know_the_environments_spaces(workplace, capsys):
    if "Floors-v0" not in gymnasium.registry:
        gymnasium.register("Floors-v0", Floors, max_episode_steps=7)
    rng = np.random.default_rng(0)
    arrays = {
        "floor": rng.integers(0, 3, 20),
        "speed": rng.normal(size=(20, 2)),
        "action": rng.uniform(-1, 1, (20, 1)),
    }
    np.savez("floors.npz", reward=np.ones(20), done=np.arange(20) % 5 == 4, **arrays)
    keys = ["--dataset-kwargs", "observation_keys:['floor','speed']"]
    assert main(["inspect", "floors.npz", "--env", "Floors-v0", "--env-kwargs", "n_floors:3", *keys]) == 0
    assert loaded(capsys.readouterr().out).observation_space.shape == (5,)


def test_a_file_controls_no_terminal(workplace, capsys, recwarn):
    """Neither by its arrays' names nor by what they say."""
    arrays = {**pendulum_arrays(), "action": pendulum_arrays()["action"] / 2, "env_id": np.array("A\x1b[2J-v0")}
    del arrays["reward"]
    np.savez("evil.npz", **arrays, **{"\x1b[31mred": np.zeros(20), "images/\x1bcamera": np.zeros((20, 8, 8, 3), np.uint8)})
    assert main(["inspect", "evil.npz"]) == 0
    shown = [capsys.readouterr().out, *(str(each.message) for each in recwarn)]
    assert any("\\x1b[2J" in text for text in shown)
    assert any("\\x1b[31mred" in text for text in shown)
    assert any("\\x1bcamera" in text for text in shown)
    assert not any("\x1b" in text for text in shown)


def pendulum_arrays():
    rng = np.random.default_rng(0)
    n = 20
    return {
        "obs": rng.normal(size=(n, 3)),
        "action": rng.uniform(-2, 2, (n, 1)),
        "reward": np.ones(n),
        "done": np.arange(n) % 5 == 4,
    }


def test_the_environment_tells_of_the_range_of_actions(workplace, capsys):
    np.savez("swings.npz", **pendulum_arrays())
    assert main(["inspect", "swings.npz"]) != 0
    assert "Give an environment (inspect: --env ID), or action_bounds=(smallest, largest)" in capsys.readouterr().err
    assert main(["inspect", "swings.npz", "--env", "Pendulum-v1"]) == 0
    text = capsys.readouterr().out
    low, high = (getattr(pendulum_arrays()["obs"][:, 1], name)() for name in ("min", "max"))
    assert f"| observation 1 | {low:.4g} to {high:.4g}, " in text
    assert "--env Pendulum-v1 --dataset swings.npz" in text
    buffer = loaded(text)
    assert (buffer.action_space.high[0], buffer.n_episodes) == (2.0, 4)
    shorter = ["--dataset-kwargs", "max_episode_steps:3"]
    with pytest.warns(UserWarning, match="4 of 4 episodes have more than 3 steps"):
        assert main(["inspect", "swings.npz", "--env", "Pendulum-v1", *shorter]) == 0
    text = capsys.readouterr().out
    with pytest.warns(UserWarning, match="4 of 4 episodes have more than 3 steps"):
        assert len(loaded(text)) == 12


def test_a_task_of_another_package_is_found(workplace, capsys):
    Path("inspected_tasks.py").write_text(
        "import gymnasium as gym\n"
        "gym.register('Inspected-v0', 'gymnasium.envs.classic_control:PendulumEnv', max_episode_steps=4)\n"
    )
    np.savez("swings.npz", **pendulum_arrays())
    with pytest.warns(UserWarning, match="4 of 4 episodes have more than 4 steps"):
        assert main(["inspect", "swings.npz", "--env", "Inspected-v0", "--gym-packages", "inspected_tasks"]) == 0
    command = capsys.readouterr().out.split("To begin with:\n")[1].splitlines()[0]
    assert command.endswith("--gym-packages inspected_tasks")
    assert main([*shlex.split(command)[1:], "-n", "2", "--eval-freq", "-1", "--verbose", "0"]) == 0


def test_images_are_named_and_drawn(workplace, capsys, monkeypatch):
    drawn = []
    monkeypatch.setattr(Axes, "imshow", lambda self, image, **kwargs: drawn.append(image))
    rng = np.random.default_rng(0)
    frames = {"image:front": rng.integers(0, 256, (20, 40, 48, 3), np.uint8)}
    frames["image:hand"] = rng.integers(0, 256, (20, 1, 40, 40), np.uint8)
    np.savez("pixels.npz", **{**pendulum_arrays(), **frames})
    assert main(["inspect", "pixels.npz", "--dataset-kwargs", "action_bounds:(-2, 2)"]) == 0
    text = capsys.readouterr().out
    assert "| images | front 40 x 48 x 3, hand 1 x 40 x 40 |" in text
    with_images = Image.open("dataset.png").size
    front, hand = (frames[f"image:{camera}"][[0, 2, 4]] for camera in ("front", "hand"))
    for image, expected in zip(drawn, [*front, *np.moveaxis(hand, 1, 3)], strict=True):  # upright, in colour
        np.testing.assert_array_equal(image, expected)
    wanted = "['image:front']"
    assert main(["inspect", "pixels.npz", "--dataset-kwargs", "action_bounds:(-2, 2)", f"observation_keys:{wanted}"]) == 0
    text = capsys.readouterr().out
    assert "| images | front 40 x 48 x 3 |" in text
    assert "never change" not in text
    assert "Stored twice" not in text
    assert Image.open("dataset.png").size[1] < with_images[1]
    assert main(["inspect", "pixels.npz", "--env", "Pendulum-v1"]) == 2
    assert "holds images front 40 x 48 x 3, hand 1 x 40 x 40; those of Pendulum-v1 are none" in capsys.readouterr().err


def test_data_of_another_environment_are_refused(workplace, capsys):
    np.savez("swings.npz", **pendulum_arrays())
    assert main(["inspect", "swings.npz", "--env", "MountainCarContinuous-v0", "--dataset-kwargs", "clip_actions:True"]) != 0
    found = capsys.readouterr().err
    assert "swings.npz holds observations of shape (3,) and actions of Box(-1.0, 1.0" in found
    assert "those of MountainCarContinuous-v0 are (2,)" in found
