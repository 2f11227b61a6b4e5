"""Readers driven with files that Hypothesis damages: no exception but our own, no hang, no memory beyond bounds."""

import resource
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sb3_dtfm.data import DatasetError, load_dataset
from tests.data import corpus

MOST_BYTES = 2**29
BOUNDED = settings(derandomize=True, deadline=None, max_examples=40, database=None, suppress_health_check=list(HealthCheck))
# Place as a share of the file, and bytes that take the place of others; no bytes cut off the rest.
damages = st.lists(
    st.tuples(st.floats(0, 1, exclude_max=True), st.one_of(st.binary(max_size=1), st.binary(min_size=1, max_size=8))),
    min_size=1,
    max_size=3,
)


@pytest.fixture(autouse=True)
def bounds() -> Iterator[None]:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    assert 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) < MOST_BYTES


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("good")
    with pytest.MonkeyPatch.context() as patch:
        corpus.write_good(folder, patch)
    return folder


def read_or_refuse(folder: Path, place: corpus.Place) -> None:
    """Read a whole dataset (as many steps as its episodes have, all finite), or have it refused."""
    options = {"observation_keys": ["state"]} if place.good == "robomimic" else {}
    dataset = place.dataset if place.dataset == corpus.MINARI_ID else folder / place.dataset
    try:
        with warnings.catch_warnings(), corpus.time_limit():
            warnings.simplefilter("ignore")
            buffer = load_dataset(dataset, **options)
    except DatasetError as error:
        assert str(folder) in str(error)  # noqa: PT017
        return
    assert len(buffer) == buffer.episode_lengths.sum() == len(buffer.actions)
    assert all(np.isfinite(array).all() for array in (buffer.observations, buffer.actions, buffer.returns_to_go))


@pytest.mark.parametrize("place", corpus.PLACES.values(), ids=corpus.PLACES)
def test_a_file_with_other_bytes_is_read_or_refused(place: corpus.Place, good: Path, monkeypatch: pytest.MonkeyPatch):
    if place.good == "zarr":
        pytest.importorskip("zarr")
    folder = good / place.good
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "datasets"))
    file = folder / place.file
    content = file.read_bytes()

    @BOUNDED
    @given(damages)
    def drive(damages: list[tuple[float, bytes]]) -> None:
        damaged = content
        for share, put in damages:
            start = int(share * len(damaged))
            damaged = damaged[:start] + (put + damaged[start + len(put) :] if put else b"")
        file.write_bytes(damaged)
        read_or_refuse(folder, place)

    try:
        drive()
    finally:
        file.write_bytes(content)


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda parts: (
        st.lists(parts, max_size=3)
        | st.dictionaries(st.sampled_from(["type", "shape", "n", "low", "id"]), parts, max_size=3)
    ),
    max_leaves=5,
)
OTHERS = ["env_spec", "eval_env_spec", "author", "combined_datasets", "ref_min_score"]
FIELDS = [*("total_episodes", "total_steps", "observation_space", "action_space", "dataset_id", "data_format"), *OTHERS]


def test_metadata_with_other_values_are_read_or_refused(good: Path, monkeypatch: pytest.MonkeyPatch):
    place = corpus.PLACES["metadata"]
    folder, file = good / place.good, good / place.good / place.file
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "datasets"))
    content = file.read_bytes()

    @BOUNDED
    @given(st.sampled_from(FIELDS), values, st.booleans())
    def drive(field: str, value: object, as_text: bool) -> None:
        file.write_bytes(content)
        corpus.metadata_change(**{field: corpus.json.dumps(value) if as_text else value})(folder)
        read_or_refuse(folder, place)

    try:
        drive()
    finally:
        file.write_bytes(content)


dtypes = st.sampled_from(["<f8", ">f4", "<f2", "<i8", "|u1", "|b1", "<c8", "|S3", "<U2", "<M8[s]", "|V4", "|O"])
shapes = st.lists(st.sampled_from([0, 1, 2, 3, 6, 15]), max_size=3).map(tuple)


def test_arrays_of_any_type_and_shape_are_read_or_refused(good: Path):
    @BOUNDED
    @given(st.sampled_from([*corpus.flat_arrays()]), dtypes, shapes)
    def drive(name: str, dtype: str, shape: tuple[int, ...]) -> None:
        corpus.npz_arrays(**{name: np.zeros(shape, dtype)})(good / "npz")
        read_or_refuse(good / "npz", corpus.PLACES["npz"])

    drive()
