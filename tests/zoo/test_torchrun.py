"""The command line on several processes: one training with torchrun, and one search by several workers."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import optuna
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_dtfm import DT, DTFM
from sb3_dtfm.cli.main import main
from sb3_dtfm.zoo.resuming import CHECKPOINT
from tests.recorded import DATASET_ID, tiny_training

TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "sb3_dtfm"]
LIMIT = 180  # seconds after which processes that wait for each other are taken as hanging


class CheckpointThenSignal(BaseCallback):
    """Saves a checkpoint at step 20, and at step 33 interrupts torchrun, or kills this process of two."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number

    def _on_step(self) -> bool:
        if self.num_timesteps == 20:
            self.model.save(Path("logs", "dtfm", "HalfCheetah-v5_1", CHECKPOINT))
        if self.num_timesteps == 33:
            os.kill(os.getppid() if self.number == signal.SIGINT else os.getpid(), self.number)
        return True


def start(*command: str, **kwargs) -> subprocess.Popen:
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parents[2])}
    return subprocess.Popen(command, env=environment, **pipes, **kwargs)


def wait_for(path: Path) -> None:
    deadline = time.monotonic() + LIMIT
    while not path.exists():
        assert time.monotonic() < deadline, f"{path} was not written within {LIMIT} s"
        time.sleep(0.1)


@pytest.mark.slow
def test_process_0_does_what_rl_zoo_does_and_the_other_leaves_no_trace(workplace):
    settings = ["--eval-freq", "2", "--eval-episodes", "1", "--save-freq", "3", "-P", "-tb", "tb"]
    process = start(*TORCHRUN, *tiny_training("dtfm", "--dataset", DATASET_ID, *settings))
    output, errors = process.communicate(timeout=LIMIT)
    assert process.returncode == 0, errors
    assert [path.name for path in (workplace / "logs" / "dtfm").iterdir()] == ["HalfCheetah-v5_1"]
    run = workplace / "logs" / "dtfm" / "HalfCheetah-v5_1"
    names = {"HalfCheetah-v5.zip", "best_model.zip", "evaluations.npz", "rl_model_3_steps.zip", "0.monitor.csv"}
    assert {path.name for path in run.iterdir()} == {*names, "HalfCheetah-v5"}
    assert np.load(run / "evaluations.npz")["timesteps"].tolist() == [0, 2, 4]
    assert DTFM.load(run / "HalfCheetah-v5.zip").num_timesteps == 4
    assert len(list((workplace / "tb").rglob("events*"))) == 1
    assert output.count("Saving to") == output.count("Log path") == output.count("Eval num_timesteps=2") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "--algo", "sac", "--env", "Pendulum-v1"], "torchrun trains dt and dtfm on several processes, not sac"),
        (tiny_training("dt", "--dataset", DATASET_ID, "-optimize"), "share a --storage and a --study-name"),
    ],
)
def test_what_several_processes_cannot_do_is_refused(arguments, message, workplace, monkeypatch, capsys):
    monkeypatch.setenv("RANK", "0")
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert main(arguments) == 2
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_an_interrupt_saves_the_model_and_ends_all(workplace):
    settings = ["--eval-freq", "-1", "--save-freq", "20", "-n", "1000000000"]
    process = start(*TORCHRUN, *tiny_training("dt", "--dataset", DATASET_ID, *settings), start_new_session=True)
    run = workplace / "logs" / "dt" / "HalfCheetah-v5_1"
    wait_for(run / "rl_model_20_steps.zip")
    os.killpg(process.pid, signal.SIGINT)  # as a terminal's Ctrl-C
    process.communicate(timeout=LIMIT)
    assert process.returncode != 0
    assert DT.load(run / "HalfCheetah-v5.zip").num_timesteps >= 20


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_training_of_two_processes_goes_on_to_the_bit(number, workplace):
    settings = ["--eval-freq", "-1", "--seed", "3", "-n", "60", "--dataset", DATASET_ID]
    straight = start(*TORCHRUN, *tiny_training("dtfm", *settings, "-f", "straight"))
    assert straight.wait(LIMIT) == 0
    signals = [{"tests.zoo.test_torchrun.CheckpointThenSignal": {"number": int(number)}}]
    interrupted = start(*TORCHRUN, *tiny_training("dtfm", f"callback:{signals!r}", *settings))
    _, errors = interrupted.communicate(timeout=LIMIT)
    assert interrupted.returncode != 0
    run = workplace / "logs" / "dtfm" / "HalfCheetah-v5_1"
    assert DTFM.load(run / CHECKPOINT).num_timesteps == 20, errors
    resumed = start(*TORCHRUN, "train", "--resume", str(run), *tiny_training("dtfm", *settings)[1:])
    _, errors = resumed.communicate(timeout=LIMIT)
    assert resumed.returncode == 0, errors
    ours, theirs = (
        DTFM.load(folder / "dtfm" / "HalfCheetah-v5_1" / "HalfCheetah-v5.zip").policy.state_dict()
        for folder in (workplace / "logs", workplace / "straight")
    )
    for name, values in theirs.items():
        assert th.equal(ours[name], values), name


@pytest.mark.slow
def test_two_workers_search_together(workplace):
    """Each does one trial, at the same time, and both find two in the study."""
    search = ["-n", "1", "-optimize", "--n-trials", "1", "--n-evaluations", "1", "--eval-episodes", "1", "--no-optim-plots"]
    shared = ["--study-name", "shared", "--storage", "studies/search.log", "--uuid"]
    command = tiny_training("dt", "--dataset", DATASET_ID, *search, *shared)
    workers = [start(sys.executable, "-m", "sb3_dtfm", *command) for _ in range(2)]
    for worker in workers:
        _, errors = worker.communicate(timeout=2 * LIMIT)
        assert worker.returncode == 0, errors
    storage = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend("studies/search.log"))
    trials = optuna.load_study(study_name="shared", storage=storage).trials
    assert [trial.state.name for trial in trials] == ["COMPLETE", "COMPLETE"]
    assert trials[0].params != trials[1].params
