"""Decisions by the data: plans or answers, returns that differ or not, few steps or many."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_dtfm import DT, DTFM
from sb3_dtfm.data import Trajectory, TrajectoryBuffer
from sb3_dtfm.data.decisions import DECIDED, decide, decide_open, sentences
from sb3_dtfm.data.predictability import correlation_of_changes, prediction_errors

SPACE = spaces.Box(-1.0, 1.0, (2,))


def make_buffer(kind: str, n_episodes: int = 20, n_steps: int = 40) -> TrajectoryBuffer:
    """
    Observations that jump about, and rewards that differ between episodes. An agent's action is a function of what it sees;
    of several agents ("several agents") the better ones act otherwise; a planner's goes on as it began, whatever it sees.
    """
    random = np.random.default_rng(0)
    episodes = []
    for number in range(n_episodes):
        observations = random.normal(size=(n_steps, 3)).astype(np.float32)
        answers = np.tanh(observations[:, :2]) + random.normal(0.0, 0.05, (n_steps, 2))
        better = answers * (1.0 - 1.5 * number / n_episodes)
        plan = random.uniform(-0.8, 0.8, 2) + np.cumsum(random.normal(0.0, 0.02, (n_steps, 2)), axis=0)
        acted = {"agent": answers, "several agents": better, "planner": plan}[kind]
        actions = np.clip(acted, -1.0, 1.0).astype(np.float32)
        rewards = np.full(n_steps, 1.0 + number / n_episodes)
        episodes.append(Trajectory(observations, actions, rewards, truncated=True))
    return TrajectoryBuffer.from_trajectories(episodes, SPACE)


def settings(buffer: TrajectoryBuffer) -> dict:
    return {each.name: each.value for each in decide(buffer)}


def test_an_agents_actions_are_taken_one_by_one_and_at_their_mean():
    buffer = make_buffer("agent")
    assert prediction_errors(buffer).plan_ratio() < 0.2
    decided = settings(buffer)
    assert (decided["chunk_size"], decided["flow_steps"], decided["regression_coef"]) == (1, 0, 1.0)


def test_a_planners_actions_are_drawn_in_chunks():
    buffer = make_buffer("planner")
    assert prediction_errors(buffer).plan_ratio() > 5.0
    decided = settings(buffer)
    assert (decided["chunk_size"], decided["flow_steps"], decided["regression_coef"]) == (8, 10, 0.0)
    assert decided["timestep_embedding"]
    assert decided["observation_scaling"] == "std"


def test_a_planners_noise_takes_robust_scaling():
    buffer = make_buffer("planner")
    buffer.stored["actions"] += 0.1 * th.randn(buffer.actions.shape, generator=th.Generator().manual_seed(0))
    decided = settings(buffer)
    assert (decided["chunk_size"], decided["observation_scaling"]) == (8, "robust")


def test_a_decision_repeats_and_leaves_the_data_alone():
    buffer = make_buffer("planner")
    before = buffer.actions.clone()
    first, again = prediction_errors(buffer), prediction_errors(buffer)
    assert all(np.array_equal(mine, its) for mine, its in zip(first, again, strict=True))
    assert buffer.actions.equal(before)


@pytest.mark.parametrize(("n_episodes", "n_steps"), [(1, 40), (5, 1)], ids=["one episode", "episodes of one step"])
def test_too_little_to_tell_is_taken_for_an_agents(n_episodes, n_steps):
    buffer = make_buffer("planner", n_episodes, n_steps)
    assert prediction_errors(buffer) is None
    assert settings(buffer)["chunk_size"] == 1
    assert any("too few episodes" in sentence for sentence in sentences(decide(buffer)))


@pytest.mark.parametrize(("kind", "expected"), [("several agents", (True, 5.0, 50)), ("agent", (False, 0.0, None))])
def test_returns_count_where_they_tell_how_an_episode_acts(kind, expected):
    decided = settings(make_buffer(kind))
    assert (
        tuple(decided.get(name) for name in ("return_conditioning", "return_weighting", "expected_return_steps")) == expected
    )


def test_cloning_learns_from_all_episodes_alike():
    buffer, names = make_buffer("several agents"), {"return_weighting", "expected_return_steps", "batch_size"}
    cloning = {each.name: each.value for each in decide_open(buffer, names, {"return_conditioning": False})}
    assert cloning == {"return_weighting": 0.0, "batch_size": settings(buffer)["batch_size"]}
    weighted = decide_open(buffer, names, {"return_conditioning": False, "return_weighting": 2.0})
    assert "return_weighting" not in {each.name for each in weighted}


def test_returns_are_not_expected_where_a_reward_tells_of_success_alone():
    buffer = make_buffer("several agents")
    buffer.rewards[buffer.timesteps < 39] = 0.0
    decided = settings(buffer)
    assert (decided["expected_return_steps"], decided["return_range"]) == (0, False)


def test_returns_that_are_all_alike_tell_nothing():
    buffer = make_buffer("several agents")
    buffer.episodes.returns[:] = 1.0
    assert prediction_errors(buffer).gain_by_return() == 0.0


def test_few_steps_make_small_batches():
    assert settings(make_buffer("agent", 20, 40))["batch_size"] == 64
    assert settings(make_buffer("agent", 20, 500))["batch_size"] == 256


def test_few_steps_of_many_dimensions_are_not_learned_by_heart():
    assert settings(make_buffer("agent", 10, 70))["dropout"] == 0.2
    assert settings(make_buffer("agent", 10, 80))["dropout"] == 0.0


def test_white_noise_takes_back_half_of_what_it_did():
    assert correlation_of_changes(make_buffer("agent", 20, 200)) == pytest.approx(-0.5, abs=0.05)
    assert correlation_of_changes(make_buffer("planner", 20, 200)) == pytest.approx(0.0, abs=0.05)
    still = make_buffer("agent")
    still.actions[:] = 0.5
    assert correlation_of_changes(still) == 0.0
    assert correlation_of_changes(make_buffer("agent", 5, 2)) == 0.0


def test_what_a_user_gives_counts():
    buffer = make_buffer("planner")
    given = DTFM("MultiInputPolicy", dataset=buffer, batch_size=32, policy_kwargs={"flow_steps": 0}, device="cpu")

    def settings(model: DTFM) -> tuple:
        return model.batch_size, model.policy.network.head.options.flow_steps, model.policy.options.chunk_size

    assert settings(given) == (32, 0, 8)
    decided = DTFM("MultiInputPolicy", dataset=buffer, device="cpu")
    assert (decided.batch_size, decided.policy.acting_settings()["flow_steps"], decided.policy.options.chunk_size) == (
        64,
        10,
        8,
    )


def test_what_is_decided_goes_with_what_a_user_gives():
    def loss_and_steps(kind: str, **policy_kwargs) -> tuple:
        model = DTFM("MultiInputPolicy", dataset=make_buffer(kind), policy_kwargs=policy_kwargs, device="cpu")
        return model.policy.network.head.options.regression_coef, model.policy.network.head.options.flow_steps

    assert loss_and_steps("planner", flow_steps=5) == (0.0, 5)
    assert loss_and_steps("planner", flow_steps=0) == (1.0, 0)
    assert loss_and_steps("agent", flow_steps=5) == (1.0, 5)
    assert loss_and_steps("agent", regression_coef=0.0) == (0.0, 10)
    assert loss_and_steps("agent", critic_steps=1, n_action_samples=4) == (1.0, 10), "a critic chooses among draws"


def test_people_are_told_each_reason_once():
    told = sentences(decide(make_buffer("planner")))
    assert told[0] == "There are 800 recorded steps, fewer than 10,000. So batch_size=64."
    assert sum("chunk_size=8" in sentence for sentence in told) == 1
    assert len(told) == 5


def test_images_are_learned_in_small_batches_by_several_draws_each():
    random = np.random.default_rng(0)
    episodes = [
        {
            "observations": {
                "camera": random.integers(0, 256, (20, 16, 16, 3), np.uint8),
                "gripper": random.random((20, 2)),
            },
            "actions": random.uniform(-1.0, 1.0, (20, 2)),
            "rewards": np.zeros(20),
            "terminated": True,
        }
        for _ in range(4)
    ]
    small = {"features_extractor_kwargs": {"features_dim": 8}}
    model = DTFM("MultiInputPolicy", dataset=episodes, policy_kwargs=small)
    assert (model.batch_size, model.policy.network.head.options.flow_draws) == (64, 8)
    assert {each.name for each in [*model.decisions, *decide(make_buffer("several agents"))]} == DECIDED
    assert any("camera" in sentence and "flow_draws=8" in sentence for sentence in sentences(model.decisions))
    assert DTFM("MultiInputPolicy", dataset=episodes, batch_size=4, policy_kwargs=small).batch_size == 4
    assert "flow_draws" not in {
        each.name for each in DT("MultiInputPolicy", dataset=episodes, policy_kwargs=small).decisions
    }
