"""Every bad dataset of the corpus is read right, or refused by our own error with file, episode and field."""

import importlib.util
import re
import shutil
import warnings
from pathlib import Path

import pytest
import torch as th

from sb3_dtfm.data import DatasetError, TrajectoryBuffer, load_dataset
from sb3_dtfm.data.storage import STEP_ARRAYS
from tests.data import corpus

GOOD = {
    **{kind: place.dataset for kind, place in corpus.PLACES.items() if kind == place.good},
    **({"zarr": str(corpus.ZARR)} if importlib.util.find_spec("zarr") else {}),
}
CASES = corpus.cases()


def load(folder: Path, kind: str, dataset: str | None = None, **options: str) -> TrajectoryBuffer:
    """One dataset of a kind in a folder, the good one if no other is named."""
    dataset = dataset or GOOD[kind]
    if kind == "robomimic":
        options = {**options, "observation_keys": ["state"]}
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings(), corpus.time_limit():
        warnings.simplefilter("error", RuntimeWarning)  # a cast that loses a part only warns
        patch.setenv("MINARI_DATASETS_PATH", str(folder / "datasets"))
        return load_dataset(dataset if dataset == corpus.MINARI_ID else folder / dataset, **options)


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("good")
    with pytest.MonkeyPatch.context() as patch:
        corpus.write_good(folder, patch)
    return folder


@pytest.fixture(scope="module")
def read_right(good: Path) -> dict[str, TrajectoryBuffer]:
    return {kind: load(good / kind, kind) for kind in GOOD}


def test_the_corpus_has_hundreds_of_datasets_of_each_reader():
    assert len({case.name for case in CASES}) == len(CASES) > 900
    kinds = [case.good for case in CASES]
    assert min(kinds.count(kind) for kind in ("hdf5", "robomimic", "npz", "flat", "lerobot", "zarr")) > 150


def test_the_good_ones_are_the_same_in_every_format(read_right: dict[str, TrajectoryBuffer]):
    for buffer in read_right.values():
        assert buffer.episode_lengths.tolist() == list(corpus.LENGTHS)
        assert buffer.observations.equal(read_right["npz"].observations)


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_a_bad_dataset_is_read_right_or_refused_with_file_episode_and_field(
    case: corpus.Case, good: Path, read_right: dict[str, TrajectoryBuffer], tmp_path: Path
):
    if case.good not in GOOD:
        pytest.skip("zarr is not installed")
    folder = shutil.copytree(good / case.good, tmp_path / "copy")
    case.change(folder)
    if not isinstance(case.expected, str):
        with pytest.raises(DatasetError) as caught:
            load(folder, case.good, case.dataset)
        said = str(caught.value)
        assert [word for word in case.expected if not re.search(word, said)] == [], said
        assert said.replace("\n", "").isprintable(), repr(said)  # a terminal obeys other characters
        return
    buffer, right = load(folder, case.good, case.dataset), read_right[case.good]
    for name in STEP_ARRAYS:
        if case.expected == corpus.SAME:
            assert getattr(buffer, name).equal(getattr(right, name)), name
        assert th.isfinite(getattr(buffer, name)).all()
    if case.expected == corpus.SAME:
        assert buffer.episode_lengths.tolist() == right.episode_lengths.tolist()


ONE_ARRAY = ("rewards: nan", "actions: complex", "actions: claimed", "rewards: link to itself")
DROPPED = [
    *(f"{kind}, {what}" for kind in ("hdf5", "robomimic") for what in ONE_ARRAY),
    *("npz, rewards: nan", "arrow, rewards: nan", "parquet: no row"),
    *("hdf5: overflowing return", "robomimic: an episode in another file"),
]


@pytest.mark.parametrize("name", DROPPED)
@pytest.mark.parametrize("cached", [False, True])
def test_an_invalid_episode_is_dropped_counted_and_told(name: str, cached: bool, good: Path, tmp_path: Path):
    [case] = [case for case in CASES if case.name == name]
    folder = shutil.copytree(good / case.good, tmp_path / "copy")
    case.change(folder)
    dropped = 0 if case.good == "npz" else corpus.DAMAGED
    options = {"cache_dir": str(tmp_path / "cache")} if cached else {}
    for _ in range(1 + cached):  # an opened cache tells it again
        with pytest.warns(UserWarning, match=rf"1 of 3 episodes .*dropped, the first for this: .*(episode.|demo_){dropped}"):
            buffer = load(folder, case.good, on_invalid="drop", **options)
        assert (buffer.n_dropped, buffer.n_episodes) == (1, 2)
        assert buffer.episode_lengths.tolist() == [n for i, n in enumerate(corpus.LENGTHS) if i != dropped]
    with pytest.raises(DatasetError):
        load(folder, case.good, **options)


def test_where_every_episode_is_invalid_none_is_left_to_learn_from(good: Path, tmp_path: Path):
    [case] = [case for case in CASES if case.name == "npz: overflowing return"]
    folder = shutil.copytree(good / "npz", tmp_path / "copy")
    case.change(folder)
    with pytest.raises(
        DatasetError, match=r"no episode that could be kept of 3 \(the first: .*episode 0, step 0: returns-to-go"
    ):
        load(folder, "npz", on_invalid="drop")


def test_on_invalid_is_one_of_two(good: Path):
    with pytest.raises(DatasetError, match="on_invalid must be one of raise, drop, got 'skip'"):
        load(good / "npz", "npz", on_invalid="skip")


MISSING_SPACES = ((), ("observation_space",), ("action_space",), ("observation_space", "action_space"))


def test_nothing_named_in_the_metadata_is_run(good: Path, tmp_path: Path):
    """Minari builds the environment of `env_spec` where a space is missing."""
    mark = tmp_path / "mark"
    spec = (
        f'{{"id": "A-v0", "entry_point": "os:system", "kwargs": {{"command": "touch {mark}"}}, "additional_wrappers": []}}'
    )
    for number, missing in enumerate(MISSING_SPACES):
        folder = shutil.copytree(good / "hdf5", tmp_path / str(number))
        corpus.metadata_change(env_spec=spec, **dict.fromkeys(missing, corpus.MISSING))(folder)
        if missing:
            with pytest.raises(DatasetError, match=f"metadata.json.*{missing[0]} is None; expected is one of type str"):
                load(folder, "hdf5")
        else:
            assert load(folder, "hdf5").env_id == "A-v0"
        assert not mark.exists()
