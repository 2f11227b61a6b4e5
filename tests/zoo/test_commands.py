"""Which model of which run is taken."""

from pathlib import Path

import pytest
from huggingface_sb3 import EnvironmentName

from sb3_dtfm.zoo.commands import find_model

ENV = EnvironmentName("robosuite/Lift-v0")


@pytest.fixture
def runs(tmp_path) -> Path:
    """Six runs: the second, the tenth and one of another task have a model, the second its best one, too."""
    for number in (1, 2, 9, 10, 11):
        (tmp_path / "dt" / f"{ENV}_{number}").mkdir(parents=True)
    other = tmp_path / "dt" / f"{ENV}_easy_20"
    other.mkdir()
    (other / f"{ENV}.zip").touch()
    for number in (2, 10):
        (tmp_path / "dt" / f"{ENV}_{number}" / f"{ENV}.zip").touch()
    (tmp_path / "dt" / f"{ENV}_2" / "best_model.zip").touch()
    return tmp_path


def test_the_latest_run_is_the_latest_with_such_a_model(runs):
    last = find_model(0, str(runs), "dt", ENV)
    assert last == ("final-model-dt-robosuite-Lift-v0", f"{runs}/dt/{ENV}_10/{ENV}.zip", f"{runs}/dt/{ENV}_10")
    assert find_model(0, str(runs), "dt", ENV, load_best=True).path == f"{runs}/dt/{ENV}_2/best_model.zip"
    assert find_model(2, str(runs), "dt", ENV).run == f"{runs}/dt/{ENV}_2"


@pytest.mark.parametrize(("exp_id", "named"), [(11, f"{ENV}_11"), (3, f"{ENV}_3")])
def test_a_run_that_is_asked_for_is_not_replaced_by_another(exp_id, named, runs):
    with pytest.raises(FileNotFoundError, match=named):
        find_model(exp_id, str(runs), "dt", ENV)
    with pytest.raises(FileNotFoundError, match=f"{ENV}_11/rl_model_5_steps.zip"):
        find_model(0, str(runs), "dt", ENV, load_checkpoint="5")
