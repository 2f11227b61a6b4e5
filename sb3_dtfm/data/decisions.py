"""Settings that are chosen from the data where the user gives none, each by a rule of a few lines."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from gymnasium import spaces

from sb3_dtfm.data.buffer import TrajectoryBuffer
from sb3_dtfm.data.predictability import PredictionErrors, correlation_of_changes, prediction_errors

# Actions that are predicted together for demonstrations by people, scripts and planners.
CHUNK_SIZE = 8
# Euler steps of the flow for such demonstrations; for other data the mean action acts.
FLOW_STEPS = 10
# w: a step of the best episode is learned from 1 + w times as often as one of the worst.
RETURN_WEIGHTING = 5.0
# Steps after which a return-to-go counts what may be expected instead of what was recorded.
EXPECTED_RETURN_STEPS = 50
# Standard errors by which knowing an episode's return has to make actions more predictable.
SIGNIFICANT = 2.0
# Recorded steps below which batches are small.
FEW_STEPS = 10_000
# Noises and times of the flow for each encoded image.
FLOW_DRAWS = 8
# Correlation of an action's successive changes below which actions are noisy.
NOISY = -0.3
# Recorded steps for each dimension of the observation below which there is dropout, and how much of it.
FEW_STEPS_PER_DIMENSION, DROPOUT = 250, 0.2

# Settings that the data decide where the user gives none.
DECIDED = frozenset(
    ("batch_size", "flow_draws", "dropout", "return_conditioning", "return_weighting", "expected_return_steps",
     "return_range", "chunk_size", "flow_steps", "regression_coef", "timestep_embedding", "observation_scaling")
)  # fmt: skip


class Decision(NamedTuple):
    """
    :param name: argument of the algorithm or the policy
    :param value: value that the argument is set to
    :param reason: the measurement, as a sentence
    """

    name: str
    value: Any
    reason: str


def decide(buffer: TrajectoryBuffer) -> list[Decision]:
    """
    Settings that differ between kinds of data.

    :param buffer: recorded episodes to learn from
    """
    errors = prediction_errors(buffer)
    by_return = _by_return(errors)
    decisions = [*_batch_size(buffer), _dropout(buffer), *by_return]
    if all(each.value for each in by_return):
        decisions += _by_reward(buffer)
    if isinstance(buffer.action_space, spaces.Box):
        decisions += _kind_of_actor(errors, correlation_of_changes(buffer), _seen(buffer))
    return decisions


def decide_open(buffer: TrajectoryBuffer, names: set[str], given: Mapping[str, Any]) -> list[Decision]:
    """
    The decisions that a user has left open.

    :param buffer: recorded episodes to learn from
    :param names: names of the available settings
    :param given: settings that the user gave, by name, which also rule out decisions about others
    """
    names = names - set(given)
    if given.get("flow_steps") == 0:  # the mean action, which a regression learns
        names.discard("regression_coef")
    if given.get("return_conditioning") is False:
        names.discard("expected_return_steps")
    if given.get("regression_coef") == 0 or given.get("critic_steps"):  # no mean action; a choice among draws
        names.discard("flow_steps")
    decisions = [each for each in decide(buffer) if each.name in names]
    if given.get("return_conditioning") is False:  # behaviour cloning, of all episodes alike
        alike = Decision("return_weighting", 0.0, "return_conditioning=False learns from all episodes alike.")
        decisions = [alike if each.name == alike.name else each for each in decisions]
    return decisions


def sentences(decisions: list[Decision]) -> list[str]:
    """One line for each reason, with the settings that it decided."""
    settings: dict[str, list[str]] = {}
    for each in decisions:
        settings.setdefault(each.reason, []).append(f"{each.name}={each.value}")
    return [f"{reason} So {', '.join(named)}." for reason, named in settings.items()]


def _batch_size(buffer: TrajectoryBuffer) -> list[Decision]:
    """
    Large batches overfit small datasets: ten demonstrations of Lift, 46 % success by batches of 256, 82 to 88 % by 64. With
    images the encoder costs most of a gradient step: small batches, whose images are used for several draws of the flow.
    """
    if buffer.image_spaces:
        reason = f"Observations hold images ({', '.join(buffer.image_spaces)}), which cost most of a gradient step."
        return [Decision("batch_size", 64, reason), Decision("flow_draws", FLOW_DRAWS, reason)]
    few = len(buffer) < FEW_STEPS
    reason = f"There are {len(buffer):,} recorded steps, {'fewer' if few else 'not fewer'} than {FEW_STEPS:,}."
    return [Decision("batch_size", 64 if few else 256, reason)]


def _dropout(buffer: TrajectoryBuffer) -> Decision:
    """
    Few steps of many dimensions are learned by heart: Relocate from 128 steps for each dimension is solved in 53 % without
    dropout and in 100 % with it, ten demonstrations of Lift in 61 and 97 % (DT) and 78 and 94 % (DTFM), of Can in 38 and
    54 % (DT), but 68 and 49 % (DTFM). Elsewhere it blurs: Pendulum from 2,000 steps for each dimension returns -160 without
    and -272 with it.
    """
    per_dimension = len(buffer) / int(buffer.observation_space.shape[0])
    few = per_dimension < FEW_STEPS_PER_DIMENSION
    number = f"{'fewer' if few else 'not fewer'} than {FEW_STEPS_PER_DIMENSION}"
    reason = f"There are {per_dimension:,.0f} recorded steps for each dimension of {_seen(buffer)}, {number}."
    return Decision("dropout", DROPOUT if few else 0.0, reason)


def _by_return(errors: PredictionErrors | None) -> list[Decision]:
    """
    Decide whether a return-to-go is seen, and better episodes are learned from more often.

    Episodes of a single agent differ by their starts and their noise: a target return of the best ones does harm, and so
    does learning from these more often. Over 34 data sets the measure was 4.2 or more where agents of several strengths,
    failures among successes or a maze's random walks were recorded, and 0 or less elsewhere.
    """
    t = 0.0 if errors is None else errors.gain_by_return()
    tells = t > SIGNIFICANT
    verb = "tells" if tells else "does not tell"
    reason = f"An episode's return {verb} how it acts (knowing it predicts held-out actions {t:.1f} standard errors better)."
    return [
        Decision("return_conditioning", tells, reason),
        Decision("return_weighting", RETURN_WEIGHTING if tells else 0.0, reason),
    ]


def _by_reward(buffer: TrajectoryBuffer) -> list[Decision]:
    """
    Decide whether returns to go are those to be expected from an observation, instead of the recorded ones.

    With returns expected after 50 steps three mediocre cheetahs with noise return 4,760 and 4,383 (two seeds) instead of
    4,237, both with a bounded return-to-go. If a reward only tells of success, success may be expected from everywhere: a
    maze of random walks is solved in 1 % instead of 27 %. Nor may failure be: of cans of which every second one is dropped,
    a policy with `return_range` puts away 70 %, without it 96 %; the maze is solved in 27 and 44 %.
    """
    rewards = buffer.rewards
    n_equal = int((rewards == rewards.mode().values).sum())
    varies = 2 * n_equal < len(rewards)
    reason = f"{n_equal / len(rewards):.0%} of the rewards are one number (half or more if they tell of success alone)."
    return [
        Decision("expected_return_steps", EXPECTED_RETURN_STEPS if varies else 0, reason),
        Decision("return_range", varies, reason),
    ]


def _seen(buffer: TrajectoryBuffer) -> str:
    """Name the input of the predictions."""
    return "the vector beside the images" if buffer.image_spaces else "the observation"


def _kind_of_actor(errors: PredictionErrors | None, correlation: float, seen: str) -> list[Decision]:
    """Settings that depend on whether previous action or observation predicts actions better."""
    ratio = None if errors is None else errors.plan_ratio()
    plans = ratio is not None and ratio > 1.0
    # The Transformer learns by the loss of what acts: the flow's, or the regression's.
    flow = {"flow_steps": FLOW_STEPS if plans else 0, "regression_coef": 0.0 if plans else 1.0}
    # Scripts depend on the time step: it raised success on Lift from 34 to 46 %, ten demonstrations and batches of 256.
    settings = {"chunk_size": CHUNK_SIZE if plans else 1, **flow, "timestep_embedding": plans}
    better, worse = ("the previous action", seen) if plans else (seen, "the previous action")
    reason = f"{better.capitalize()} predicts actions better than {worse} does (ratio of squared errors {ratio or 0.0:.3g})."
    if ratio is None:
        reason = f"There are too few episodes to compare how {seen} and the previous action predict actions."
    # Ten scripted demonstrations of Lift: 76 % success with "std", 43 % with "robust"; human Adroit door: 6 and 49 %.
    robust = not plans or correlation < NOISY
    noise = f"Successive changes of an action correlate by {correlation:.2f} (noise does by less than {NOISY})."
    scaling = Decision("observation_scaling", "robust" if robust else "std", noise if plans else reason)
    return [*(Decision(name, value, reason) for name, value in settings.items()), scaling]
