"""The actor waits for the critics."""

import copy

import gymnasium as gym
import pytest
import torch as th
from stable_baselines3 import PPO, SAC, TD3

from sb3_dtfm.finetuning import HoldActor


@pytest.mark.parametrize("algorithm", [SAC, TD3])
def test_the_actor_learns_after_the_critics(algorithm):
    agent = algorithm(
        "MlpPolicy", "Pendulum-v1", learning_starts=10, batch_size=8, policy_kwargs=dict(net_arch=[16]), seed=0
    )
    actor, critic = (copy.deepcopy(each.state_dict()) for each in (agent.actor, agent.critic))

    def learned(module, before):
        return any((module.state_dict()[key] != value).any() for key, value in before.items())

    agent.learn(30, callback=HoldActor(20))
    assert agent._n_updates == 20
    assert learned(agent.critic, critic)
    assert not learned(agent.actor, actor)
    assert all(parameter.requires_grad for parameter in agent.actor.parameters()), "as it was"
    agent.learn(10, callback=HoldActor(20), reset_num_timesteps=False)
    assert learned(agent.actor, actor)
    assert all(th.isfinite(parameter).all() for parameter in agent.policy.parameters())


def test_what_has_no_actor_is_refused():
    with pytest.raises(ValueError, match="HoldActor: PPO has no actor beside its critics"):
        PPO("MlpPolicy", gym.make("Pendulum-v1"), n_steps=8, batch_size=8).learn(8, callback=HoldActor(1))
    with pytest.raises(ValueError, match="n_updates must be a whole number of at least 1, got 0"):
        HoldActor(0)
