"""`sb3-dtfm train --resume`: a run that was ended or killed becomes what it would have been."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_dtfm import DTFM
from sb3_dtfm.cli.main import main
from sb3_dtfm.zoo.resuming import CHECKPOINT, START
from tests.recorded import DATASET_ID, tiny_training, undo_checkpoints

RUN = Path("logs/dtfm/HalfCheetah-v5_1")
N_STEPS, SIGNAL_AT, KILL_AT = 40, 17, 26
SETTINGS = ["--dataset", DATASET_ID, "-n", str(N_STEPS), "-tb", "tb", "--log-interval", "5"]
SETTINGS += ["--eval-freq", "10", "--eval-episodes", "2", "--vec-env", "dummy"]


class SignalAt(BaseCallback):
    """Sends this process a signal during some gradient step."""

    def __init__(self, step: int, number: int) -> None:
        super().__init__()
        self.step, self.number = step, number

    def _on_step(self) -> bool:
        if self.num_timesteps == self.step:
            os.kill(os.getpid(), self.number)
        return True


class SignalAtReset(gym.Wrapper):
    """Sends this process SIGTERM at some reset, in the midst of an evaluation, where nothing has been sent before."""

    n_resets = 0
    sends_at: int | None = None

    def reset(self, **kwargs):
        type(self).n_resets += 1
        if self.n_resets == self.sends_at:
            os.kill(os.getpid(), signal.SIGTERM)
        return super().reset(**kwargs)


def finds_tests() -> dict[str, str]:
    """An environment for processes that find the callbacks above."""
    return {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}


class ResumeAt(SignalAt):
    """Has another process resume the run that is in its midst."""

    def _on_step(self) -> bool:
        if self.num_timesteps == self.step:
            command = [sys.executable, "-m", "sb3_dtfm", "train", "--resume", str(RUN), "--gym-packages", __name__]
            subprocess.run(command, env=finds_tests())
        return True


def training(*callbacks: tuple[int, int], kind: str = "SignalAt") -> list[str]:
    """The command; seeds are drawn by RL-Zoo unless a test says otherwise."""
    signals = [{f"{__name__}.{kind}": {"step": step, "number": int(number)}} for step, number in callbacks]
    return tiny_training("dtfm", *([f"callback:{signals!r}"] if signals else []), *SETTINGS, "--seed", "3")


def weights(path: Path) -> th.Tensor:
    model = DTFM.load(path)
    states = model.policy.optimizer.state_dict()["state"].values()
    return th.cat([x.flatten() for x in (*model.policy.state_dict().values(), *(x for s in states for x in s.values()))])


def curves() -> dict[str, list[tuple[int, float]]]:
    """TensorBoard's curves of the only run, but for the time."""
    (folder,) = Path("tb/HalfCheetah-v5").iterdir()
    events = EventAccumulator(str(folder)).Reload()
    names = [name for name in events.Tags()["scalars"] if not name.startswith("time/")]
    return {name: [(event.step, event.value) for event in events.Scalars(name)] for name in names}


def evaluations() -> dict[str, list]:
    with np.load(RUN / "evaluations.npz") as saved:
        return {name: saved[name].tolist() for name in saved.files}


def what_was_learned() -> tuple[th.Tensor, th.Tensor, dict, dict]:
    return weights(RUN / "HalfCheetah-v5.zip"), weights(RUN / "best_model.zip"), curves(), evaluations()


def resume(*arguments: str) -> int:
    """In the next second: files of events are read in the order of their names, which begin with the second."""
    time.sleep(1.0 - time.time() % 1.0)
    return main(["train", "--resume", str(RUN), *arguments])


def assert_same(ours, theirs):
    for one, other in zip(ours[:2], theirs[:2], strict=True):
        assert th.equal(one, other)
    assert ours[2] == theirs[2]
    assert ours[3] == theirs[3]


@pytest.fixture(scope="module")
def straight(minari_folder, tmp_path_factory):
    """Results of an undisturbed run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("straight"))
        patch.setenv("MINARI_DATASETS_PATH", str(minari_folder))
        assert main(training()) == 0
        expected = what_was_learned()
    assert [step for step, _ in expected[2]["train/loss"]] == list(range(5, N_STEPS + 1, 5))
    assert expected[3]["timesteps"] == list(range(0, N_STEPS + 1, 10))
    return expected


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_an_interrupted_run_goes_on_in_its_folder_to_the_bit(number, code, straight, workplace, capsys):
    if code:
        with pytest.raises(SystemExit) as ended:
            main(training((SIGNAL_AT, number)))
        assert ended.value.code == code
    else:
        assert main(training((SIGNAL_AT, number))) == 0
    assert f"--resume {RUN}" in capsys.readouterr().out
    assert DTFM.load(RUN / CHECKPOINT).num_timesteps == SIGNAL_AT + 1
    assert DTFM.load(RUN / "HalfCheetah-v5.zip").num_timesteps == SIGNAL_AT + 1
    assert resume() == 0
    assert_same(what_was_learned(), straight)
    assert not (RUN / CHECKPOINT).exists()
    assert [path.name for path in Path("logs/dtfm").iterdir()] == [RUN.name]
    assert resume() == 2
    assert "the run is finished" in capsys.readouterr().err


def test_sigterm_saves_any_algorithm(workplace):
    ending = "callback:[{'tests.zoo.test_resuming.SignalAt': {'step': 32, 'number': 15}}]"
    command = ["train", "--algo", "ppo", "--env", "Pendulum-v1", "-n", "640", "--eval-freq", "-1", "--verbose", "0"]
    with pytest.raises(SystemExit) as ended:
        main([*command, "-params", "n_envs:1", "n_steps:16", "batch_size:16", "normalize:False", ending])
    assert ended.value.code == 143
    assert 32 <= PPO.load("logs/ppo/Pendulum-v1_1/Pendulum-v1.zip", device="cpu").num_timesteps < 640


def kill(interval: float) -> None:
    """Kill a run in its midst, whose last checkpoint is of step 18, or which has none."""
    script = (
        "import torch; torch.set_num_threads(1)\n"
        "import sb3_dtfm.zoo.resuming as resuming\nfrom sb3_dtfm.cli.main import main\n"
        "save = resuming.KeepCheckpoint.save\n"
        f"resuming.CHECKPOINT_INTERVAL = {interval}\n"
        "resuming.KeepCheckpoint.save = lambda keeper: save(keeper) if keeper.num_timesteps <= 18 else None\n"
        f"main({training((KILL_AT, signal.SIGKILL))!r})\n"
    )
    killed = subprocess.run([sys.executable, "-c", script], env=finds_tests(), stdout=subprocess.DEVNULL)
    assert killed.returncode == -signal.SIGKILL
    assert (RUN / START).is_file()


@pytest.fixture(scope="module")
def killed(minari_folder, tmp_path_factory):
    """Folder of a run that was killed behind its last checkpoint."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder := tmp_path_factory.mktemp("killed"))
        patch.setenv("MINARI_DATASETS_PATH", str(minari_folder))
        kill(0.0)
    return folder


def test_a_killed_run_goes_on_from_its_last_checkpoint(killed, straight, workplace):
    """Killed behind a log entry and an evaluation that its checkpoint does not know: they are not there twice."""
    shutil.copytree(killed, ".", dirs_exist_ok=True)
    assert (RUN / CHECKPOINT).is_file()
    assert resume(*training()[1:]) == 0
    assert_same(what_was_learned(), straight)


def test_a_run_that_was_killed_before_its_first_checkpoint_begins_anew(straight, workplace):
    kill(1e9)
    assert not (RUN / CHECKPOINT).exists()
    assert resume(*training()[1:]) == 0
    assert_same(what_was_learned(), straight)


@pytest.mark.parametrize("given_back", ["what was deleted", "another model of the run"])
def test_without_its_checkpoint_a_killed_run_does_not_begin_anew(given_back, killed, straight, workplace, capsys):
    shutil.copytree(killed, ".", dirs_exist_ok=True)
    checkpoint = RUN / CHECKPOINT
    kept = checkpoint.rename("kept.zip")
    held = {path: path.read_bytes() for path in RUN.rglob("*") if path.is_file()}
    for _ in range(2):
        assert main(["train", "--resume", str(RUN)]) == 2
        error = capsys.readouterr().err.strip().splitlines()[-1]
        assert f"--resume {RUN}: {CHECKPOINT} is missing" in error
        assert {path: path.read_bytes() for path in RUN.rglob("*") if path.is_file()} == held
    if given_back == "what was deleted":
        kept.rename(checkpoint)
    else:
        command = error.split("newest model there: ")[1].removesuffix(".")
        assert command == f"cp {RUN / 'best_model.zip'} {checkpoint}"
        assert subprocess.run(command.split()).returncode == 0
        assert DTFM.load(checkpoint).num_timesteps in (0, 10, 20)
    assert resume(*training()[1:]) == 0
    assert_same(what_was_learned(), straight)


def test_a_run_without_a_seed_goes_on_with_the_one_that_was_drawn(workplace):
    arguments = [argument for argument in training((SIGNAL_AT, signal.SIGINT)) if argument not in ("--seed", "3")]
    assert main(arguments) == 0
    seed = DTFM.load(RUN / CHECKPOINT).seed
    assert resume() == 0
    model = DTFM.load(RUN / "HalfCheetah-v5.zip")
    assert (model.seed, model.num_timesteps) == (seed, N_STEPS)


def test_other_arguments_beside_resume_neither_start_nor_delete_anything(workplace, capsys):
    assert main(training((SIGNAL_AT, signal.SIGINT))) == 0
    files = sorted(RUN.rglob("*"))
    assert resume("-P") == 2
    assert "takes no other arguments but --gym-packages and --conf-file; it was" in capsys.readouterr().err
    assert sorted(RUN.rglob("*")) == files


def test_what_an_agent_knew_is_not_lost_with_a_run_that_was_killed_early(workplace):
    assert main(training()) == 0
    agent = RUN / "HalfCheetah-v5.zip"
    assert main([*training((SIGNAL_AT, signal.SIGINT)), "-i", str(agent)]) == 0
    second = RUN.with_name("HalfCheetah-v5_2")
    undo_checkpoints(second)
    assert main(["train", "--resume", str(second)]) == 0
    model = DTFM.load(second / "HalfCheetah-v5.zip")  # which the same signal has interrupted again
    assert (model.num_timesteps, model._n_updates) == (SIGNAL_AT + 1, N_STEPS + SIGNAL_AT + 1)


def test_a_run_that_is_being_trained_is_left_to_its_process(straight, workplace, capfd):
    assert main(training((SIGNAL_AT, 0), kind="ResumeAt")) == 0
    assert f"--resume {RUN}: another process is training it; wait for its end, or end it first." in capfd.readouterr().err
    assert_same(what_was_learned(), straight)
    assert not list(RUN.glob(".*"))


@pytest.mark.parametrize(
    ("run", "message"),
    [
        ("logs/dtfm/absent_1", "no such folder"),
        (".", "nothing to go on with"),
    ],
)
def test_what_cannot_be_resumed_is_said(run, message, workplace, capsys):
    assert main(["train", "--resume", run]) == 2
    assert f"--resume {run}" in (error := capsys.readouterr().err)
    assert message in error


# Two episodes each: 5 of random actions begin the run; an evaluation resets before its first episode and after each.
@pytest.mark.parametrize(("reset", "step"), [(2, 0), (9, 0), (11, 10), (20, N_STEPS)])
def test_a_signal_ends_an_evaluation_which_the_resumed_run_repeats(reset, step, straight, workplace, monkeypatch):
    wrapper = f"env_wrapper:'{__name__}.SignalAtReset'"
    monkeypatch.setattr(SignalAtReset, "n_resets", 0)
    monkeypatch.setattr(SignalAtReset, "sends_at", reset)
    command = training()
    command.insert(command.index("-params") + 1, wrapper)
    with pytest.raises(SystemExit) as ended:
        main(command)
    assert ended.value.code == 143
    assert SignalAtReset.n_resets == reset
    assert DTFM.load(RUN / CHECKPOINT).num_timesteps == step
    assert DTFM.load(RUN / "HalfCheetah-v5.zip").num_timesteps == step
    assert resume() == 0
    assert_same(what_was_learned(), straight)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-30])


def pickle_them(path: Path) -> None:
    np.savez(path, timesteps=np.array([0, 10]), results=np.array([None, None]), ep_lengths=np.zeros((2, 2)))


def forget(path: Path) -> None:
    np.savez(path, timesteps=np.array([N_STEPS]), results=np.ones((1, 2)), ep_lengths=np.ones((1, 2)))


def confuse(path: Path) -> None:
    np.savez(path, timesteps=np.array([0, 10]), results=np.full((3, 2), -1e9), ep_lengths=np.ones((3, 2)))


DAMAGES = [
    Path.unlink,
    truncate,
    pickle_them,
    forget,
    confuse,
    lambda path: path.write_bytes(b""),
    lambda path: path.write_text("x"),
    lambda path: (path.unlink(), os.mkfifo(path)),
]


def test_without_its_evaluations_a_run_does_not_replace_its_best_model(straight, workplace, capsys):
    assert main(training((SIGNAL_AT, signal.SIGINT))) == 0
    path, model = RUN / "evaluations.npz", RUN / "best_model.zip"
    whole, best = path.read_bytes(), model.read_bytes()
    (RUN / ".evaluations.npz").write_bytes(whole[:99])  # of a process that was killed while it wrote
    for damage in DAMAGES:
        path.unlink(missing_ok=True)
        path.write_bytes(whole)
        damage(path)
        assert main(["train", "--resume", str(RUN)]) == 2
        error = capsys.readouterr().err.strip().splitlines()[-1]
        assert f"{path}: expected the evaluations up to step {SIGNAL_AT + 1}" in error
        assert model.read_bytes() == best
    path.unlink()
    path.write_bytes(whole)
    assert resume() == 0
    assert_same(what_was_learned(), straight)
