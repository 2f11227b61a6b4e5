"""Settings that are chosen from the data where the user gives none, each by a rule of a few lines."""

from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_dtfm.actions import bounds_of, vector_space
from sb3_dtfm.data.buffer import TrajectoryBuffer

# Actions that are predicted together for demonstrations by people, scripts and planners.
CHUNK_SIZE = 8
# Euler steps of the flow for such demonstrations; for other data the mean action acts.
FLOW_STEPS = 10
# Ridge regression: share of held-out episodes, most steps of each part, random features, penalties.
HELD_OUT, MAX_STEPS, N_FEATURES, PENALTIES = 0.2, 8192, 512, (1e-3, 1e-1, 10.0)
CLIP, SMALLEST_STD = 10.0, 1e-6
# Standard deviation of the episodes' returns, as a share of the largest absolute one, below which they count as equal.
SMALLEST_SPREAD = 0.05
# Recorded steps below which batches are small.
FEW_STEPS = 10_000


class Decision(NamedTuple):
    """
    :param name: argument of the policy
    :param value: what it is set to
    :param reason: the measurement, as a sentence
    """

    name: str
    value: Any
    reason: str


def decide(buffer: TrajectoryBuffer) -> list[Decision]:
    """
    Settings that differ between kinds of data.

    :param buffer: what is learned from
    """
    decisions = [_batch_size(buffer), _return_conditioning(buffer)]
    if isinstance(buffer.action_space, spaces.Box):
        decisions += _kind_of_actor(buffer)
    return decisions


def sentences(decisions: list[Decision]) -> list[str]:
    """One line for each reason, with the settings that it decided."""
    settings: dict[str, list[str]] = {}
    for each in decisions:
        settings.setdefault(each.reason, []).append(f"{each.name}={each.value}")
    return [f"{reason} So {', '.join(named)}." for reason, named in settings.items()]


def _batch_size(buffer: TrajectoryBuffer) -> Decision:
    """Large batches overfit small datasets: on Lift's ten demonstrations 256 windows reached 46 % success, 64 82 to 88 %."""
    few = len(buffer) < FEW_STEPS
    reason = f"There are {'few' if few else 'many'} recorded steps ({len(buffer):,})."
    return Decision("batch_size", 64 if few else 256, reason)


def _return_conditioning(buffer: TrajectoryBuffer) -> Decision:
    """Where returns hardly differ, a return-to-go tells the moment of an episode and not its quality."""
    spread = float(buffer.episode_returns.std() / max(np.abs(buffer.episode_returns).max(), SMALLEST_STD))
    differ = spread >= SMALLEST_SPREAD
    verb = "differ" if differ else "hardly differ"
    reason = f"Returns of episodes {verb} (standard deviation {spread:.1%} of the largest absolute return)."
    return Decision("return_conditioning", differ, reason)


def _kind_of_actor(buffer: TrajectoryBuffer) -> list[Decision]:
    """Settings that depend on whether previous action or observation predicts actions better, see :func:`plan_ratio`."""
    ratio = plan_ratio(buffer)
    plans = ratio is not None and ratio > 1.0
    # The trunk learns by the loss of what acts: the flow's, or the regression's.
    flow = {"n_solver_steps": FLOW_STEPS if plans else 0, "regression_coef": 0.0 if plans else 1.0}
    # Scripts depend on the time step: it raised success on Lift from 34 to 46 %, ten demonstrations and batches of 256.
    settings = {"chunk_size": CHUNK_SIZE if plans else 1, **flow, "timestep_embedding": plans, "calm_units": not plans}
    better, worse = ("The previous action", "the observation") if plans else ("The observation", "the previous action")
    reason = f"{better} predicts actions better than {worse} does (ratio of squared errors {ratio or 0.0:.3g})."
    if ratio is None:
        reason = "There are too few episodes to compare how observation and previous action predict actions."
    return [Decision(name, value, reason) for name, value in settings.items()]


def plan_ratio(buffer: TrajectoryBuffer) -> float | None:
    """
    How much better the previous action predicts an action than the observation does, on episodes held out.

    People and scripts follow plans that an observation does not show: repeating the last action is the better guess. Agents
    of reinforcement learning compute each action from the observation: a regression is the better guess. Chunks of actions
    drawn from the flow copy a plan; the mean action leaves out an agent's noise. Over 30 data sets the ratio was 0.03 to 0.8
    for agents and 1.7 or more for people, scripts and planners; Adroit's door by people (0.9 to 1.5) falls on either side.

    :param buffer: Box actions
    :return: mean squared error of the best of three ridge regressions (on the observation and 512 random features of it)
        over that of repeating the previous action, on at most 8,192 steps of the held-out episodes; None where there is one
        episode only, or no step that follows another
    """
    n_held = max(1, round(HELD_OUT * buffer.n_episodes))
    order = np.random.default_rng(0).permutation(buffer.n_episodes)
    if len(order) == n_held:
        return None
    generator = th.Generator().manual_seed(0)
    held, others = (buffer.select(np.sort(part)).to("cpu") for part in (order[:n_held], order[n_held:]))
    mean, std = (th.as_tensor(each).float() for each in buffer.statistics()[:2])
    std = th.where(std > SMALLEST_STD, std, 1.0)
    weight = 2.0 * th.randn(len(mean), N_FEATURES, generator=generator) / len(mean) ** 0.5
    bias = th.randn(N_FEATURES, generator=generator)

    def steps(part: TrajectoryBuffer) -> tuple[th.Tensor, th.Tensor, th.Tensor, th.Tensor]:
        """Features, actions, the actions before, and whether there were any."""
        chosen = th.randperm(len(part), generator=generator)[:MAX_STEPS]
        windows = part.windows(chosen, context_length=2)
        seen = ((windows.observations[:, 1] - mean) / std).clamp(-CLIP, CLIP)
        features = th.cat((seen, (seen @ weight + bias).relu(), th.ones(len(seen), 1)), dim=1).double()
        before, actions = windows.actions.double().unbind(1)
        return features, actions, before, windows.mask[:, 0]

    features, actions, _, _ = steps(others)
    asked, wanted, before, follows = steps(held)
    if not follows.any():
        return None
    asked, wanted, before = asked[follows], wanted[follows], before[follows]
    low, high = (th.as_tensor(bound).double() for bound in bounds_of(vector_space(buffer.action_space)))
    products, offset = features.T @ features, actions.mean(dim=0)
    penalty = products.diagonal().mean() * th.eye(len(products), dtype=th.float64)
    errors = []
    for share in PENALTIES:
        solved = th.linalg.solve(products + share * penalty, features.T @ (actions - offset))
        errors.append(((asked @ solved + offset - wanted) / (high - low)).square().mean())
    repeated = ((before - wanted) / (high - low)).square().mean()
    return float(min(errors) / repeated.clamp(min=1e-12))
