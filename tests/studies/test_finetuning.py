"""What fine-tuning brought is measured and shown."""

import json

import finetuning
import numpy as np

from sb3_dtfm.cli.main import main
from tests.recorded import DATASET_ID, tiny_training


def test_a_run_is_measured_and_reported(workplace, capsys):
    assert main(tiny_training("dtfm", "dataset:" + repr(DATASET_ID))) == 0
    before = workplace / "logs/dtfm/HalfCheetah-v5_1"
    settings = ["-params", "n_episodes:2", "gradient_steps:2", "n_envs:2", "batch_size:4"]
    command = ["finetune", "--algo", "dtfm", "--env", "HalfCheetah-v5", "--model", str(before), "-n", "80", *settings]
    assert main([*command, "--eval-freq", "40", "--eval-episodes", "3"]) == 0
    row = finetuning.measure(workplace / "logs/dtfm/HalfCheetah-v5_2", before)
    assert len(row["before"]["returns"]) == len(row["after"]["returns"]) == 100
    assert row["before"]["returns"] != row["after"]["returns"]
    assert set(row["before"]["lengths"]) == {20}
    assert row["timesteps"] == [0, 40, 80]
    assert np.shape(row["scores"]) == (3, 3)
    assert [length for *_, length in row["own"]] == [20] * 4
    for seed in range(3):
        (workplace / f"cheetah_dtfm_seed{seed}.json").write_text(json.dumps(row))
    capsys.readouterr()
    finetuning.report(workplace, workplace / "curves.png")
    reached = f"{np.mean(row['after']['returns']):,.0f}"
    assert f"| {', '.join([reached] * 3)} | 80 | " in capsys.readouterr().out.replace(" [nan, nan]", "")
    assert (workplace / "curves.png").stat().st_size > 5000
