"""Callbacks: what they evaluate, when, and what they log."""

import re

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import EvalCallback, EveryNTimesteps, StopTrainingOnRewardThreshold
from stable_baselines3.common.monitor import Monitor
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_dtfm import DT, DTFM, callbacks
from sb3_dtfm.callbacks import EvaluateAtStartAndEnd, FlowFigure
from sb3_dtfm.data import ScoreReference
from tests.algorithms.small import make_model, record_curves
from tests.conftest import make_env
from tests.data.small import make_buffer

SCORE = "eval/normalized_score"


@pytest.fixture
def model(cheetah_buffer, monkeypatch):
    """Learns from episodes on whose scale a return of -100 is 0 and one of 100 is 1."""
    monkeypatch.setattr(cheetah_buffer, "score_reference", ScoreReference(-100.0, 100.0, "test scale"))
    return make_model(DT, cheetah_buffer)


def evaluate_every(n_steps: int, **kwargs) -> EvalCallback:
    return EvalCallback(Monitor(make_env()), eval_freq=n_steps, n_eval_episodes=1, verbose=0, **kwargs)


def learn(model: DT, n_steps: int, callback, **kwargs) -> dict[str, list[tuple[int, float]]]:
    curves = record_curves(model)
    model.learn(n_steps, callback=callback, **kwargs)
    return curves.points


def check_scores(records: dict[str, list[tuple[int, float]]]) -> list[int]:
    """The steps of the normalised scores, after a look at their values."""
    assert records[SCORE] == [(step, pytest.approx((mean + 100) / 200)) for step, mean in records["eval/mean_reward"]]
    return [step for step, _ in records[SCORE]]


def test_a_score_is_logged_once_for_each_evaluation_whatever_triggers_it(model):
    periodic, every = evaluate_every(4), EveryNTimesteps(3, evaluate_every(1))
    assert check_scores(learn(model, 10, [periodic])) == [4, 8]
    assert check_scores(learn(model, 10, [every])) == [3, 6, 9]
    again = learn(model, 4, [periodic], reset_num_timesteps=False)  # calls go on being counted, from ten
    assert check_scores(again) == [12]


def test_the_evaluation_that_ends_training_has_its_score_too(model):
    stop = StopTrainingOnRewardThreshold(-1e9)
    assert check_scores(learn(model, 10, evaluate_every(3, callback_on_new_best=stop))) == [3]


@pytest.mark.parametrize(("n_steps", "evaluated"), [(10, [0, 4, 8, 10]), (8, [0, 4, 8]), (3, [0, 3]), (0, [0])])
def test_start_and_end_are_evaluated_and_no_step_twice(n_steps, evaluated, model, tmp_path):
    evaluation = evaluate_every(4, log_path=str(tmp_path), best_model_save_path=str(tmp_path))
    records = learn(model, n_steps, [evaluation, EvaluateAtStartAndEnd([evaluation])])
    assert check_scores(records) == evaluated
    arrays = np.load(tmp_path / "evaluations.npz")
    assert arrays["timesteps"].tolist() == evaluated
    means = [mean for _, mean in records["eval/mean_reward"]]
    assert arrays["results"].mean(axis=1).tolist() == pytest.approx(means)
    assert evaluation.best_mean_reward == max(means)
    assert DT.load(tmp_path / "best_model.zip").num_timesteps == evaluated[int(np.argmax(means))]


def test_start_and_end_of_an_evaluation_that_an_event_triggers(model):
    evaluation = evaluate_every(1)
    callbacks = [EveryNTimesteps(4, evaluation), EvaluateAtStartAndEnd([evaluation])]
    assert check_scores(learn(model, 6, callbacks)) == [0, 4, 6]


def test_continued_training_goes_on_with_its_intervals(model):
    evaluation = evaluate_every(4)
    callbacks = [evaluation, EvaluateAtStartAndEnd([evaluation])]
    learn(model, 6, callbacks)
    assert check_scores(learn(model, 6, callbacks, reset_num_timesteps=False)) == [8, 12], "6 was evaluated as the end"


def test_what_is_not_to_be_evaluated_is_not(model):
    evaluation = evaluate_every(-1)
    assert SCORE not in learn(model, 3, [evaluation, EvaluateAtStartAndEnd([evaluation])])


def test_an_evaluation_before_the_first_step_changes_no_weight(cheetah_buffer):
    evaluation = evaluate_every(100, deterministic=False)
    plain = make_model(DT, cheetah_buffer).learn(5)
    evaluated = make_model(DT, cheetah_buffer).learn(5, callback=[evaluation, EvaluateAtStartAndEnd([evaluation])])
    for name, tensor in plain.policy.state_dict().items():
        assert th.equal(tensor, evaluated.policy.state_dict()[name]), name


def test_the_flow_is_drawn_into_tensorboard(tmp_path, capsys):
    """Beside a log in the terminal, which holds no pictures."""
    model = make_model(DTFM, make_buffer([5, 6]), tensorboard_log=str(tmp_path), verbose=1)
    model.learn(4, callback=EveryNTimesteps(2, FlowFigure()))
    events = EventAccumulator(str(tmp_path / "DTFM_1")).Reload()
    assert [image.step for image in events.Images("eval/flow")] == [2, 4]
    first, second = (image.encoded_image_string for image in events.Images("eval/flow"))
    assert len(first) > 5000
    assert first != second
    assert "train/" in capsys.readouterr().out


@pytest.mark.parametrize(("algorithm", "n_numbers"), [(DT, 0), (DTFM, 6)])
def test_what_has_no_flow_in_two_dimensions_is_not_drawn(algorithm, n_numbers, cheetah_buffer):
    model = make_model(algorithm, cheetah_buffer)
    with pytest.raises(ValueError, match=f"Only a flow of two numbers .* starts from {n_numbers} numbers"):
        model.learn(1, callback=EveryNTimesteps(1, FlowFigure()))


def test_learning_begins_by_saying_how_often_it_will_see_the_data(capsys):
    model = make_model(DTFM, make_buffer([5, 7]), batch_size=4, verbose=1)
    model.learn(6, log_interval=None)
    assert "6 gradient steps of 4 windows: 2.0 epochs of 12 recorded steps" in capsys.readouterr().out
    model.learn(3, log_interval=None, reset_num_timesteps=False)
    assert "3 gradient steps of 4 windows: 1.0 epochs of 12 recorded steps" in capsys.readouterr().out


@pytest.fixture
def at_once(monkeypatch):
    """The time that is left is told as soon as so many gradient steps are timed."""
    monkeypatch.setattr(callbacks, "SECONDS_TIMED", 0.0)


def test_learning_says_once_how_long_the_rest_takes(at_once, capsys):
    make_model(DTFM, make_buffer([5, 7]), batch_size=4, verbose=1).learn(30, log_interval=1)
    left = r"About \S+ (s|min) left on this CPU \([\d.,]+ gradient steps a second\)\."
    assert len(re.findall(left, capsys.readouterr().out)) == 1


@pytest.mark.parametrize(("n_steps", "verbose"), [(3, 1), (30, 0)])
def test_a_short_or_silent_training_says_nothing_of_it(n_steps, verbose, at_once, capsys):
    make_model(DT, make_buffer([5, 7]), batch_size=4, verbose=verbose).learn(n_steps, log_interval=None)
    assert "left" not in capsys.readouterr().out


def test_more_than_half_an_hour_is_a_warning_with_what_to_change(at_once):
    model = make_model(DT, make_buffer([5, 7]), batch_size=4)
    with pytest.warns(UserWarning, match=r"About [\d.,]+ h left on this CPU .* lower total_timesteps.*embed_dim") as caught:
        model.learn(10**8, callback=lambda *_: model.num_timesteps < 20, log_interval=None)
    assert [warning.filename for warning in caught] == [__file__]


def test_the_time_left_changes_nothing_that_is_learned(at_once):
    silent, spoken = (make_model(DT, make_buffer([5, 7]), batch_size=4, verbose=verbose).learn(20) for verbose in (0, 1))
    for name, tensor in silent.policy.state_dict().items():
        assert th.equal(tensor, spoken.policy.state_dict()[name]), name


@pytest.mark.parametrize(
    ("seconds", "said"), [(8.2, "8.2 s"), (89, "89 s"), (90, "1.5 min"), (3000, "50 min"), (22_000, "6.1 h"), (1e6, "280 h")]
)
def test_a_duration_has_two_digits(seconds, said):
    assert callbacks._duration(seconds) == said
