"""The speed of fine-tuning is measured, by what is learned in."""

import finetuning_speed
import pytest


@pytest.mark.parametrize("algo", ["sac", "ppo"])
def test_environments_are_timed_alone_and_behind_a_wrapper(algo):
    rows = list(finetuning_speed.measure("HalfCheetah-v5", 2, "dummy", algo, 0.3))
    measured = [(row["what"], row.get("algo")) for row in rows]
    assert measured == [("bare", None), ("rollouts", None), ("wrapped", algo), ("learning", algo)]
    bare, *behind = (row["steps_per_s"] for row in rows)
    assert 0 < max(behind) < bare
    for row in rows[1:]:
        shares = row["shares"]
        assert 0 < shares["environment"] < sum(shares.values()) <= 1


def test_what_is_not_packaged_is_refused():
    with pytest.raises(SystemExit, match=r"ppo.*Hopper-v5.*NoiseActionVecEnv, not ResidualActionVecEnv"):
        list(finetuning_speed.measure_algorithm("ppo", "Hopper-v5", 1, "dummy", 0.1))
