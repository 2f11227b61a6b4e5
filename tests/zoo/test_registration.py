"""RL-Zoo's tables after registration."""

import optuna
import pytest
from rl_zoo3 import ALGOS
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER

from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.zoo.registration import register


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_registered_beside_rl_zoos_own(algo):
    register()
    assert ALGOS[algo] is ALGORITHMS[algo]
    assert {"sac", "ppo", "tqc"} <= set(ALGOS)


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_a_trial_read_back_gives_the_arguments_it_was_sampled_with(algo, cheetah_buffer):
    register()
    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=1))
    trial = study.ask()
    sampled = HYPERPARAMS_SAMPLER[algo](trial, 6, 1, {})
    assert HYPERPARAMS_CONVERTER[algo](trial.params) == sampled
    model = ALGORITHMS[algo]("MultiInputPolicy", dataset=cheetah_buffer, device="cpu", **sampled)
    assert model.batch_size == sampled["batch_size"]
