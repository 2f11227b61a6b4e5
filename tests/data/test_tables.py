"""Tables, with a row for each step: DataFrames, CSV and Parquet."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from gymnasium import spaces

from sb3_dtfm.data import DatasetError, load_dataset

COLUMNS = {
    "episode": ["b", "b", "a", "a", "a"],
    "obs_0": [0.0, 1.0, 2.0, 3.0, 4.5],
    "obs_1": [1, 1, 1, 2, 2],
    "action": [0.5, -1.0, 1.0, 0.0, 0.25],
    "reward": [0, 1, 0, 0, 2],
}
NAMED = dict(observation_keys=["position", "speed"], action_keys=["force"])
NAMES = {"obs_0": "position", "obs_1": "speed", "action": "force"}


def as_csv(path, columns):
    rows = [["" if each is None else str(each) for each in row] for row in zip(*columns.values(), strict=True)]
    rows = [",".join(columns), *map(",".join, rows)]
    (path / "log.csv").write_text("\n".join(rows) + "\n")
    return path / "log.csv"


def as_parquet(path, columns):
    pq.write_table(pa.table(columns), path / "log.parquet")
    return path / "log.parquet"


def as_frame(path, columns):
    return pytest.importorskip("pandas").DataFrame(columns)


KINDS = {"csv": as_csv, "parquet": as_parquet, "DataFrame": as_frame}


@pytest.fixture(params=KINDS.values(), ids=KINDS)
def write(request, tmp_path):
    return lambda columns: request.param(tmp_path, columns)


def check(buffer):
    np.testing.assert_array_equal(buffer.observations, np.stack([COLUMNS["obs_0"], COLUMNS["obs_1"]], axis=1))
    np.testing.assert_array_equal(buffer.actions[:, 0], COLUMNS["action"])
    assert buffer.episode_lengths.tolist() == [2, 3]
    assert buffer.episode_returns.tolist() == [1, 2]


@pytest.mark.parametrize("episodes", [["b", "b", None, "a", "a"], [1, 1, None, 2, 2], ["b", "b", "", "a", "a"]])
def test_an_episode_is_named_at_each_step(write, episodes):
    with pytest.raises(DatasetError, match="episode is not given at each step"):
        load_dataset(write({**COLUMNS, "episode": episodes}))


def test_columns_by_how_they_begin_or_by_name(write):
    check(load_dataset(write(COLUMNS)))
    named = write({NAMES.get(name, name): column for name, column in COLUMNS.items()})
    check(load_dataset(named, **NAMED))
    with pytest.raises(
        DatasetError, match=r"has no array called one of actions.*Name the columns with observation_keys=\[...\] and"
    ):
        load_dataset(named)


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_a_file_is_cached(kind, tmp_path):
    path = KINDS[kind](tmp_path, COLUMNS)
    for _ in range(2):
        check(load_dataset(path, cache_dir=tmp_path / "cache"))


def test_whole_numbers_are_choices_where_the_environment_has_some(write):
    table = write({**COLUMNS, "action": [0, 1, 1, 0, 1]})
    assert load_dataset(table, action_space=spaces.Discrete(2)).actions[:, 1].tolist() == [0, 1, 1, 0, 1]
    assert load_dataset(table, action_space=spaces.Box(-1, 1, (1,))).actions[:, 0].tolist() == [0, 1, 1, 0, 1]


def test_columns_of_vectors(tmp_path):
    vectors = {"obs": [[0.0, 1.0]] * 4, "action": [[0.5]] * 4, "reward": [1.0] * 4, "done": [False, True, False, True]}
    for write in (as_parquet, as_frame):
        buffer = load_dataset(write(tmp_path, vectors))
        assert (buffer.observation_space.shape, buffer.terminated.tolist()) == ((2,), [True, True])


@pytest.mark.parametrize("kind", ["list_", "large_list", "list_view", "large_list_view"])
def test_parquet_columns_of_any_kind_of_list(kind, tmp_path):
    if not hasattr(pa, kind):
        pytest.skip("this pyarrow has none")
    vectors = pa.array([[0.0, 1.0], [2.0, 3.0]], getattr(pa, kind)(pa.float64()))
    numbers = {"action": [0.5, -0.5], "reward": [1.0, 2.0], "done": [False, True]}
    buffer = load_dataset(as_parquet(tmp_path, {"obs": vectors, **numbers}))
    assert buffer.observations.tolist() == [[0, 1], [2, 3]]


def test_numbered_columns_come_by_their_numbers(write):
    """As text, 10 comes before 2."""
    rest = {name: COLUMNS[name] for name in ("episode", "action", "reward")}
    numbered = {f"obs[{number}]": [float(number)] * 5 for number in (10, 2, 0)}
    assert load_dataset(write({**numbered, **rest})).observations[0].tolist() == [0, 2, 10]
    matrix = {f"obs_{i}_{j}": [10.0 * i + j] * 5 for j in range(2) for i in (1, 0)}
    others = {"obs_next_0": [9.0] * 5, "action_probability": [9.0] * 5}
    table = {**matrix, **others, "action_0": COLUMNS["action"], "episode": COLUMNS["episode"], "reward": COLUMNS["reward"]}
    with pytest.warns(UserWarning, match="action_0 are read, and not action_probability"):
        buffer = load_dataset(write(table))
    assert buffer.observations[0].tolist() == [0, 1, 10, 11]
    assert buffer.actions.shape == (5, 1)
    named = {f"state.{name}": [float(number)] * 5 for number, name in enumerate(("speed", "angle_2"))}
    assert load_dataset(write({**named, **rest})).observations[0].tolist() == [0, 1]


def test_steps_of_an_episode_lie_side_by_side(write):
    with pytest.raises(DatasetError, match=r"episode a comes in several places; .* as after a stable sort"):
        load_dataset(write({**COLUMNS, "episode": list("ababa")}))


@pytest.mark.parametrize("kind", ["DataFrame", "parquet"])
def test_images_in_a_column_are_told_of_and_read_if_they_are_named(kind, tmp_path):
    pandas = pytest.importorskip("pandas")
    images = np.random.default_rng(0).integers(0, 256, (4, 8, 9, 3), dtype=np.uint8)
    columns = {"obs_0": np.arange(4.0), "action": [0.5] * 4, "reward": [1.0] * 4, "done": [0, 0, 0, 1]}
    if kind == "parquet":
        pixels = pa.array(images.tolist(), pa.list_(pa.list_(pa.list_(pa.uint8()))))
        table = tmp_path / "steps.parquet"
        pq.write_table(pa.table({**columns, "pixels": pixels}), table)
    else:
        table = pandas.DataFrame({**columns, "pixels": list(images)})
    with pytest.warns(UserWarning, match=r"pixels has an image of shape \(8, 9, 3\) for each step, and is not read"):
        assert load_dataset(table).image_spaces == {}
    tables = [table, pandas.read_parquet(table)] if kind == "parquet" else [table]
    for each in tables:
        buffer = load_dataset(each, observation_keys=["obs_0", "pixels"])
        np.testing.assert_array_equal(buffer.own("pixels").numpy(), images)
        assert buffer.observations[:, 0].tolist() == [0.0, 1.0, 2.0, 3.0]


@pytest.mark.parametrize("first", [[], None])
def test_a_column_of_lists_that_nobody_needs_may_hold_anything(first, tmp_path):
    steps = {"obs_0": [0.0, 1.0], "action": [[[0.5, 0.1], [0.2, 0.3]]] * 2, "reward": [1.0, 1.0], "done": [0, 1]}
    boxes = pa.array([first, [[1.0, 2.0], [3.0]]], pa.list_(pa.list_(pa.float64())))
    pq.write_table(pa.table({**steps, "detected": boxes}), tmp_path / "steps.parquet")
    buffer = load_dataset(tmp_path / "steps.parquet")
    np.testing.assert_allclose(buffer.actions[0].numpy(), [0.5, 0.1, 0.2, 0.3])


@pytest.mark.parametrize("is_contiguous", [True, False])
def test_tensors_of_arrow_keep_their_shape(is_contiguous, tmp_path):
    images = np.random.default_rng(0).integers(0, 256, (2, 8, 9, 3), dtype=np.uint8)
    columns = {"obs_0": pa.array([0.0, 1.0]), "action": pa.array([0.5, 0.1]), "reward": pa.array([1.0, 1.0])}
    tensors = pa.FixedShapeTensorArray.from_numpy_ndarray(images if is_contiguous else images.transpose(0, 3, 1, 2).copy())
    if not is_contiguous:  # (8, 9, 3) that lie in memory as (3, 8, 9)
        kind = pa.fixed_shape_tensor(pa.uint8(), (3, 8, 9), permutation=(1, 2, 0))
        tensors = pa.ExtensionArray.from_storage(kind, tensors.storage)
    pq.write_table(pa.table({**columns, "done": pa.array([0, 1]), "pixels": tensors}), tmp_path / "steps.parquet")
    buffer = load_dataset(tmp_path / "steps.parquet", observation_keys=["obs_0", "pixels"])
    np.testing.assert_array_equal(buffer.own("pixels").numpy(), images)


def test_pictures_of_pillow_in_a_column(tmp_path):
    pandas, image = pytest.importorskip("pandas"), pytest.importorskip("PIL.Image")
    images = np.random.default_rng(0).integers(0, 256, (2, 8, 9, 3), dtype=np.uint8)
    columns = {"obs_0": [0.0, 1.0], "action": [0.5, 0.1], "reward": [1.0, 1.0], "done": [0, 1]}
    table = pandas.DataFrame({**columns, "pixels": [image.fromarray(each) for each in images]})
    buffer = load_dataset(table, observation_keys=["obs_0", "pixels"])
    np.testing.assert_array_equal(buffer.own("pixels").numpy(), images)


def test_columns_of_an_environments_entries_are_read_where_there_are_none_that_begin_with_obs():
    pandas = pytest.importorskip("pandas")
    columns = {"b": [0.0, 1.0], "a": [2.0, 3.0], "action": [0.5, 0.1], "reward": [1.0, 1.0], "done": [0, 1]}
    space = spaces.Dict(a=spaces.Box(-9, 9, (1,)), b=spaces.Box(-9, 9, (1,)))
    named = load_dataset(pandas.DataFrame(columns), observation_space=space)
    np.testing.assert_array_equal(named.observations.numpy(), [[2.0, 0.0], [3.0, 1.0]])
    own = load_dataset(pandas.DataFrame({**columns, "obs_0": [7.0, 8.0]}), observation_space=space)
    assert own.observations.tolist() == [[7.0], [8.0]]
    goals = pandas.DataFrame({**columns, "observation": [4.0, 5.0], "obstacles": [6.0, 7.0]})
    parts = dict.fromkeys(("a", "b", "observation", "obstacles"), spaces.Box(-9, 9, (1,)))
    entries = load_dataset(goals, observation_space=spaces.Dict(parts))
    assert entries.observations.tolist() == [[2.0, 0.0, 4.0, 6.0], [3.0, 1.0, 5.0, 7.0]]
