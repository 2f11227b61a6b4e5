"""Flat arrays in one file: what is read, and what is refused."""

import io
import os
import warnings
import zipfile

import gymnasium as gym
import h5py
import numpy as np
import pytest
from gymnasium import spaces

from sb3_dtfm import DT
from sb3_dtfm.data import DatasetError, load_dataset, load_flat
from sb3_dtfm.envs import ReturnToGoWrapper

N, STOPS = 9, [2, 5, 9]


def arrays(**changes):
    """Nine steps of three episodes; None leaves an array out."""
    rng = np.random.default_rng(0)
    found = dict(
        observations=rng.normal(size=(N, 3)), actions=rng.uniform(-1, 1, (N, 2)), rewards=np.arange(N, dtype=float),
        episode_ends=np.array(STOPS),
    )  # fmt: skip
    return {name: array for name, array in {**found, **changes}.items() if array is not None}


def write(path, **changes):
    np.savez(path, **arrays(**changes))
    return path


@pytest.fixture
def path(tmp_path):
    return tmp_path / "episodes.npz"


def flags(*steps):
    marked = np.zeros(N, bool)
    marked[list(steps)] = True
    return marked


ENDS = {
    "ends": {},
    "lengths": dict(episode_ends=None, episode_lengths=np.diff(STOPS, prepend=0)),
    "flags of two kinds": dict(episode_ends=None, terminals=flags(1), timeouts=flags(4)[:, None]),
}


@pytest.mark.parametrize("changes", ENDS.values(), ids=ENDS)
def test_episodes_are_what_was_written(changes, path):
    buffer = load_dataset(str(write(path, **changes)))
    expected = arrays()
    assert buffer.episode_lengths.tolist() == [2, 3, 4]
    assert buffer.episode_returns.tolist() == [1.0, 9.0, 26.0]
    np.testing.assert_array_equal(buffer.observations, expected["observations"].astype(np.float32))
    np.testing.assert_array_equal(buffer.actions, expected["actions"].astype(np.float32))
    assert buffer.returns_to_go.tolist() == [1, 1, 9, 7, 4, 26, 21, 15, 8]
    assert buffer.terminated.tolist() == [True, False, False] if "terminals" in changes else [False] * 3


NUMBERED = {
    "numbers": dict(episode=np.repeat([4, 0, 7], [2, 3, 4])),
    "ids": dict(episode_ids=np.repeat([1, 2, 1000], [2, 3, 4])[:, None]),
    "dones": dict(dones=flags(1, 4, 8)),
    "dones and timeouts": dict(done=flags(1, 4, 8), timeouts=flags(4)),
}


@pytest.mark.parametrize("kind", NUMBERED)
def test_numbers_and_dones_tell_of_episodes(kind, path):
    buffer = load_dataset(write(path, episode_ends=None, **NUMBERED[kind]))
    assert buffer.episode_lengths.tolist() == [2, 3, 4]
    assert buffer.terminated.tolist() == ["done" in kind, kind == "dones", "done" in kind]
    assert buffer.truncated.tolist() == [False, kind == "dones and timeouts", False]


@pytest.mark.parametrize("kind", ["ends", "lengths"])
def test_flags_inside_an_episode_are_told_of(kind, path):
    message = "terminals: 2 steps inside episodes are flagged as ends, first step 1 of episode 1"
    with pytest.warns(UserWarning, match=f"{message}. Episodes end where episode_{kind} says"):
        buffer = load_dataset(str(write(path, **ENDS[kind], terminals=flags(1, 3, 6, 8))))
    assert buffer.episode_lengths.tolist() == [2, 3, 4]
    assert buffer.terminated.tolist() == [True, False, True]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_dataset(str(write(path, **ENDS[kind], terminals=flags(1, 8), timeouts=flags(4))))


def test_a_number_that_comes_again_is_no_episode(path):
    with pytest.raises(DatasetError, match=r"episode 4 comes in several places; .* after a stable sort"):
        load_dataset(write(path, episode_ends=None, episode=np.array([4, 4, 5, 5, 5, 4, 4, 4, 4])))


def test_of_dones_those_at_the_time_limit_are_truncated(path):
    buffer = load_dataset(write(path, episode_ends=None, dones=flags(1, 4, 8)), max_episode_steps=4)
    assert (buffer.terminated.tolist(), buffer.truncated.tolist()) == ([True, True, False], [False, False, True])
    buffer = load_dataset(write(path, rewards=np.ones(N)), max_episode_steps=4)
    assert (buffer.terminated.tolist(), buffer.truncated.tolist()) == ([False] * 3, [False, False, True])


def test_terminals_alone_do_not_tell_of_timeouts(path):
    write(path, episode_ends=None, terminals=flags(1))
    with pytest.warns(UserWarning, match=r"terminals tell of terminal states, and nothing tells of time-outs: .* joined"):
        assert load_dataset(path).episode_lengths.tolist() == [2, 7]
    with pytest.warns(UserWarning, match=r"1 episodes of more than max_episode_steps=3 are cut after as many steps"):
        buffer = load_dataset(path, max_episode_steps=3)
    assert buffer.episode_lengths.tolist() == [2, 3, 3, 1]
    assert buffer.episode_returns.tolist() == [1, 9, 18, 8]
    assert buffer.terminated.tolist() == [True, False, False, False]
    assert buffer.truncated.tolist() == [False, True, True, False]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_dataset(write(path, episode_ends=None, terminals=flags(1), timeouts=flags(4)))
        load_dataset(write(path, terminals=flags(1)))


def test_without_rewards_every_episode_is_a_success(path):
    with pytest.warns(
        UserWarning, match=r"none of rewards, .*, nor any success, so that every episode counts as a success, rewa"
    ):
        buffer = load_flat(write(path, rewards=None))
    assert buffer.rewards.tolist() == [0, 1, 0, 0, 1, 0, 0, 0, 1]
    assert buffer.terminated.all()


def test_other_names_and_chosen_observations(path):
    extra = np.arange(N * 4.0).reshape(N, 2, 2)
    write(path, observations=None, actions=None, state=np.ones((N, 1)), action=np.zeros((N, 2)), keypoint=extra)
    assert load_flat(path).observation_space.shape == (1,)
    both = load_flat(path, observation_keys=["keypoint", "state"])
    np.testing.assert_array_equal(both.observations, np.hstack([extra.reshape(N, 4), np.ones((N, 1))]))


ENTRIES = spaces.Dict(observation=spaces.Box(-9, 9, (2,)), desired_goal=spaces.Box(-9, 9, (1,)), pressed=spaces.Discrete(3))


@pytest.mark.parametrize("source", [write, lambda path, **changes: arrays(**changes)], ids=["npz", "memory"])
def test_arrays_by_the_names_of_an_environment_s_entries_are_the_observation(source, path):
    """In the wrapper's order. If one is missing or of another size, the array of observations is read as ever."""
    parts = dict(observation=np.ones((N, 2)), desired_goal=np.arange(N, dtype=float), pressed=np.arange(N) % 3)
    read = {"observations": None, **parts}
    one_hot = np.eye(3)[parts["pressed"]]
    expected = np.hstack([parts["desired_goal"][:, None], parts["observation"], one_hot])
    buffer = load_dataset(source(path, **read), observation_space=ENTRIES)
    np.testing.assert_array_equal(buffer.observations, expected)
    choice = load_dataset(
        source(path, observations=None, observation=np.arange(N)),
        observation_space=spaces.Dict(observation=spaces.Discrete(N)),
    )
    np.testing.assert_array_equal(choice.observations, np.eye(N))
    chosen = load_dataset(source(path, **read), observation_space=ENTRIES, observation_keys=["observation"])
    assert chosen.observation_space.shape == (2,)
    for change in ({"pressed": None}, {"observation": np.ones((N, 3))}):
        others = load_dataset(source(path, **{**parts, **change}), observation_space=ENTRIES)
        np.testing.assert_allclose(others.observations, arrays()["observations"], rtol=1e-6)
    flattened = load_dataset(source(path, **{**read, "pressed": one_hot}), observation_space=ENTRIES)
    np.testing.assert_array_equal(flattened.observations, expected)


@pytest.mark.parametrize("source", [write, lambda path, **changes: arrays(**changes)], ids=["npz", "memory"])
@pytest.mark.parametrize("name", ["front", "image:front"])
def test_an_entry_may_be_a_camera(source, name, path):
    frames = np.zeros((N, 6, 5, 3), np.uint8)
    space = spaces.Dict(
        front=spaces.Box(0, 255, (6, 5, 3), np.uint8), state=spaces.Box(-9, 9, (2,)), goal=spaces.Box(-9, 9, (1,))
    )
    read = {"observations": None, name: frames, "state": np.ones((N, 2)), "goal": np.zeros((N, 1))}
    buffer = load_dataset(source(path, **read), observation_space=space)
    assert list(buffer.image_spaces) == ["front"]
    np.testing.assert_array_equal(buffer.observations, [[0, 1, 1]] * N)


def test_an_entry_may_be_called_as_observations_often_are(path):
    frames = np.zeros((N, 6, 5, 3), np.uint8)
    space = spaces.Dict(obs=spaces.Box(0, 255, (6, 5, 3), np.uint8), where=spaces.MultiDiscrete([[2, 3]]))
    read = {"observations": None, "obs": frames, "where": np.ones((N, 1, 2), int)}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert list(load_dataset(write(path, **read), observation_space=space).image_spaces) == ["obs"]


def test_what_is_learned_is_no_entry(path):
    """An environment may observe its last action; the array of that name holds the next one."""
    space = spaces.Dict(observations=spaces.Box(-9, 9, (3,)), actions=spaces.Box(-1, 1, (2,)))
    np.testing.assert_allclose(
        load_dataset(write(path), observation_space=space).observations, arrays()["observations"], rtol=1e-6
    )


def test_lists_are_entries_too():
    """Steps that were appended to lists; an array that is not read may be ragged."""
    lists = dict(observation=[[1.0, 2.0]] * N, desired_goal=[[3.0]] * N, pressed=[1] * N, ragged=[[1], [1, 2]] * 5)
    buffer = load_dataset({**arrays(observations=None), **lists}, observation_space=ENTRIES)
    np.testing.assert_array_equal(buffer.observations, [[3, 1, 2, 0, 1, 0]] * N)


def hdf5(path, **changes):
    path = path.with_suffix(".hdf5")
    with h5py.File(path, "w") as file:
        for name, array in arrays(**changes).items():
            file[name] = array
    return path


@pytest.mark.parametrize("source", [write, hdf5, lambda path, **changes: arrays(**changes)], ids=["npz", "hdf5", "memory"])
def test_images_of_another_name_are_told_of(source, path):
    """Whatever they are called, but not what is read, chosen, known or no image of each step."""
    frames = np.zeros((N, 6, 5, 3), np.uint8)
    with pytest.warns(UserWarning, match=r"pixels has an image of shape \(6, 5, 3\) .*not read\. Call it image:pixels, or"):
        assert load_dataset(source(path, pixels=frames)).image_spaces == {}
    read = {"image:front": frames, "next_observations": frames, "short": frames[1:], "floats": frames / 255}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert list(load_dataset(source(path, **read)).image_spaces) == ["front"]
        chosen = load_dataset(source(path, pixels=frames), observation_keys=["observations"])
    assert chosen.image_spaces == {}


@pytest.mark.parametrize("source", [write, lambda path, **changes: arrays(**changes)], ids=["npz", "memory"])
def test_images_may_be_all_that_is_observed(source, path):
    frames = np.zeros((N, 6, 5, 3), np.uint8)
    alone = source(path, **{"image:front": frames, "observations": None})
    buffer = load_dataset(alone)
    assert list(buffer.image_spaces) == ["front"]
    assert not buffer.observations.any()
    with pytest.raises(DatasetError, match=r"image:front .*float64"):
        load_dataset(source(path, **{"image:front": frames / 255, "observations": None}))


def test_arrays_that_are_not_read_may_hold_anything(path):
    """Neither memory nor Python is spent on them: a shape of 2**45 bytes, objects, and no array at all."""
    write(path, objects=np.array([len, {}], dtype=object))
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"shape": (N, 2**20, 2**20, 3), "fortran_order": False, "descr": "|u1"})
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("huge.npy", header.getvalue())
        archive.writestr("broken.npy", header.getvalue()[:9])
        archive.writestr("notes.txt", "hello")
    with pytest.warns(UserWarning, match="huge has an image of shape .1048576, 1048576, 3."):
        assert len(load_dataset(path)) == N


def test_names_and_numbers_of_episodes_may_be_objects():
    for episodes in (["b", 1, 2.0], [b"b", np.int64(1), np.float64(2.0)]):
        named = np.repeat(np.array(episodes, dtype=object), [2, 3, 4])
        assert load_flat(arrays(episode_ends=None, episode=named)).episode_lengths.tolist() == [2, 3, 4]


def test_control_characters_of_names_are_not_printed(path):
    write(path, actions=None, **{"\x1b[2J": np.zeros(N)})
    with pytest.raises(DatasetError, match=r"only \\x1b\[2J, episode_ends, obs") as refusal:
        load_dataset(path)
    assert "\x1b" not in str(refusal.value)


def test_an_opened_hdf5_file_is_read_like_a_path(tmp_path):
    """Links in it too: a pipe behind one would wait for ever."""
    os.mkfifo(tmp_path / "pipe")
    with h5py.File(tmp_path / "episodes.hdf5", "w") as file:
        for name, array in arrays().items():
            file[name] = file[f"part/{name}"] = array
        for opened in (file, file["part"]):
            assert load_dataset(opened).episode_lengths.tolist() == [2, 3, 4]
        file["another"] = h5py.ExternalLink(str(tmp_path / "pipe"), "/")
        assert load_dataset(file).n_episodes == 3
        del file["part/rewards"]
        file["part/rewards"] = h5py.ExternalLink(str(tmp_path / "pipe"), "/")
        with pytest.raises(DatasetError, match=r"episodes\.hdf5/part: 'rewards' lies in another file"):
            load_dataset(file["part"])


def create_nbit(file, name, data, chunks):
    """h5py has no argument for it."""
    layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    layout.set_chunk(chunks)
    layout.set_filter(h5py.h5z.FILTER_NBIT)
    space = h5py.h5s.create_simple(data.shape)
    created = h5py.h5d.create(file.id, name.encode(), h5py.h5t.IEEE_F32LE, space, layout)
    created.write(h5py.h5s.ALL, h5py.h5s.ALL, data)


@pytest.mark.parametrize(
    ("options", "name"), [({"scaleoffset": 4}, "scaleoffset"), ({"compression": "szip"}, "szip"), (None, "nbit")]
)
def test_filters_that_do_not_tell_what_is_missing_are_refused(options, name, tmp_path):
    """HDF5 makes up the numbers of a chunk of theirs that was cut off: whole ones are refused, too."""
    with h5py.File(tmp_path / "episodes.hdf5", "w") as file:
        for key, array in arrays().items():
            file[key] = array
        del file["observations"]
        given = dict(name="observations", data=np.ones((N, 3), np.float32), chunks=(N, 3))
        if options is None:
            create_nbit(file, **given)
        else:
            file.create_dataset(**given, **options)
    with pytest.raises(DatasetError, match=rf"observations are stored with the filter {name}.*h5repack -f GZIP=4"):
        load_dataset(tmp_path / "episodes.hdf5")


def test_bounds_of_actions(path):
    write(path, actions=np.linspace(0, 512, 2 * N).reshape(N, 2))
    buffer = load_flat(path, action_bounds=(0, [512, 600]))
    assert buffer.action_space.high.tolist() == [512, 600]
    assert load_flat(path, clip_actions=True).actions.max() == 1.0
    cached = load_dataset(path, cache_dir=path.parent / "cache", action_bounds=(np.zeros(2), np.array([512, 600])))
    assert cached.action_space == buffer.action_space
    with pytest.raises(
        DatasetError, match=r"episodes.npz, episode 0, step 0: action 30.* outside .*\[-1, 1\].*action_bounds=\("
    ):
        load_flat(path)
    for known in (dict(action_bounds=(0, 1)), dict(action_space=spaces.Box(0, 1, (2,)))):
        with pytest.raises(DatasetError, match=r"outside of the action space \[0, 1\]\.$"):
            load_flat(path, **known)
    with pytest.raises(DatasetError, match=r"action_bounds is \(0, 1, 2\); smallest and largest action .* or 2 each"):
        load_flat(path, action_bounds=(0, 1, 2))


REFUSED = {
    "no actions": (
        dict(actions=None),
        "has no array called one of actions, action, acts, only episode_ends, observations, rewards",
    ),
    "no ends": (
        dict(episode_ends=None),
        "does not say where episodes end; one of episode_ends, episode_lengths, episode, term",
    ),
    "ends before the end": (dict(episode_ends=[2, 5]), "episode_ends tells of 5 steps in all; actions have 9"),
    "an empty episode": (dict(episode_ends=[2, 2, 9]), "episode_ends tells of 0 steps in episode 1"),
    "no episode": (dict(episode_ends=np.zeros(0, int)), "episode_ends tells of 0 steps in all"),
    "other length": (dict(rewards=np.zeros(8)), r"rewards has shape \(8,\) and actions have 9 steps"),
    "infinite actions": (dict(actions=np.full((N, 2), np.inf)), "episode 0, step 0: actions hold inf"),
    "NaN": (dict(observations=np.full((N, 3), np.nan)), "episode 0, step 0: observations hold nan"),
    "flat actions": (dict(actions=np.zeros(N)), r"actions have shape \(9,\); \(N, A\) is expected"),
    "words": (dict(rewards=np.array(["good"] * N)), "rewards hold <U4; real numbers are expected"),
    "two rewards": (dict(rewards=np.zeros((N, 2))), "rewards have 2 columns"),
    "pickles": (
        dict(rewards=np.array([print] * N)),
        "rewards is a pickle of Python objects, which can run code .* allow_pickle=True",
    ),
}


@pytest.mark.parametrize(("changes", "message"), REFUSED.values(), ids=REFUSED)
def test_what_does_not_fit_is_refused_by_name(changes, message, path):
    with pytest.raises(DatasetError, match=f"episodes.npz.*{message}"):
        load_flat(write(path, **changes), clip_actions=True)


def test_an_hdf5_file_in_d4rls_layout(tmp_path):
    path = tmp_path / "hopper.hdf5"
    found = arrays(episode_ends=None, terminals=flags(1), timeouts=flags(4))
    with h5py.File(path, "w") as file:
        for name, array in {**found, "infos/qpos": np.zeros((N, 2)), "next_observations": np.zeros((N, 3))}.items():
            file[name] = array
    buffer = load_dataset(str(path))
    assert buffer.episode_lengths.tolist() == [2, 3, 4]
    assert (buffer.terminated.tolist(), buffer.truncated.tolist()) == ([True, False, False], [False, True, False])
    np.testing.assert_array_equal(buffer.observations, found["observations"].astype(np.float32))
    cached = load_dataset(path, cache_dir=tmp_path / "cache", action_space=spaces.Box(-2, 2, (2,)))
    assert cached.action_space == spaces.Box(-2, 2, (2,))
    wider = load_dataset(path, cache_dir=tmp_path / "cache", action_bounds=None, action_space=spaces.Box(-3, 3, (2,)))
    assert wider.action_space == spaces.Box(-3, 3, (2,)), "a cache of its own"
    np.testing.assert_array_equal(cached.returns_to_go, buffer.returns_to_go)
    with h5py.File(path, "a") as file:
        del file["rewards"]
        file["rewards"] = np.array([b"good"] * N)
    with pytest.raises(DatasetError, match=r"hopper.hdf5: rewards hold .*S4; real numbers"):
        load_dataset(path)


def test_a_group_of_an_hdf5_file_is_a_dictionary(tmp_path):
    found = arrays()
    parts = {"b": found["observations"][:, :1], "a": found["observations"][:, 1:]}
    images = np.random.default_rng(0).integers(0, 256, (N, 8, 8, 3), dtype=np.uint8)
    rest = {name: array for name, array in found.items() if name != "observations"}
    path = tmp_path / "groups.hdf5"
    with h5py.File(path, "w") as file:
        for name, array in {**rest, "observations/camera": images, **{f"observations/{p}": parts[p] for p in parts}}.items():
            file[name] = array
    buffer = load_dataset(path, action_bounds=(-3, 3))
    np.testing.assert_array_equal(buffer.observations, np.roll(found["observations"], -1, axis=1).astype(np.float32))
    np.testing.assert_array_equal(buffer.own("camera").numpy(), images)
    chosen = load_dataset(path, action_bounds=(-3, 3), observation_keys=["b"])
    np.testing.assert_array_equal(chosen.observations, parts["b"].astype(np.float32))
    with h5py.File(path, "a") as file:
        file["observations/deeper/c"] = parts["b"]
    with pytest.raises(DatasetError, match=r"observations: deeper is a group of 'c'; an array of numbers is expected"):
        load_dataset(path, action_bounds=(-3, 3))
    with h5py.File(path, "a") as file:
        del file["observations/deeper"]
        zeros = file.create_dataset("observations/zeros", data=np.zeros((N, 10**6), np.int8), compression="gzip")
        for number in range(9):
            file[f"observations/again_{number}"] = zeros
    with pytest.raises(DatasetError, match=r"observations claim 90\d+ bytes, of which \d+ are stored"):
        load_dataset(path, action_bounds=(-3, 3))


def test_a_dictionary_of_arrays():
    found = arrays()
    parts = {"b": found["observations"][:, :1], "a": {"c": found["observations"][:, 1:]}}
    buffer = load_dataset({**found, "observations": parts}, action_bounds=(-3, 3))
    np.testing.assert_array_equal(buffer.observations, np.roll(found["observations"], -1, axis=1).astype(np.float32))
    assert buffer.action_space == spaces.Box(-3, 3, (2,))
    lists = {name: array.tolist() for name, array in found.items()}
    assert load_dataset(lists).episode_returns.tolist() == [1, 9, 26]
    with pytest.raises(DatasetError, match=r"arrays: observations, b has shape \(\); one entry a step"):
        load_dataset({**found, "observations": {"a": found["observations"], "b": 1}})
    with pytest.raises(DatasetError, match=r"arrays: observations has entries of different lengths: {'a': 9, 'b': 8}"):
        load_dataset({**found, "observations": {"a": found["observations"], "b": np.zeros(8)}})
    with pytest.raises(TypeError, match=r"a dictionary of flat arrays: unknown option cache_dir"):
        load_dataset(found, cache_dir="cache")


def test_the_range_of_actions_is_the_environments_where_nobody_says(path):
    model = DT("MultiInputPolicy", ReturnToGoWrapper(gym.make("Pendulum-v1"), 0.0), dataset=pendulum(), device="cpu")
    assert model.buffer.action_space == spaces.Box(-2, 2, (1,))
    model.buffer.select(np.array([1])).save(path)
    assert load_dataset(str(path)).action_space == spaces.Box(-2, 2, (1,))
    with pytest.raises(DatasetError, match=r"holds actions of Box\(-1.0, 1.0.*, the environment's are Box\(-2.0"):
        DT(
            "MultiInputPolicy",
            model.env,
            dataset=pendulum(),
            dataset_kwargs={"action_bounds": (-1, 1), "clip_actions": True},
        )


def pendulum():
    rng = np.random.default_rng(1)
    return dict(obs=rng.normal(size=(6, 3)), acts=rng.uniform(-2, 2, (6, 1)), rews=-np.ones(6), episode_lengths=[4, 2])


def test_what_a_buffer_saves_is_what_it_holds(path):
    whole = load_flat(write(path, episode_ends=None, terminals=flags(1, 8), timeouts=flags(4)), action_bounds=(-1, [1, 3]))
    whole.env_id = "Walker2d-v5"
    part = whole.select(np.array([2, 0]))
    part.save(path.parent / "part")
    again = load_dataset(path.parent / "part.npz", action_space=spaces.Box(-9, 9, (2,)))
    for name in ("observations", "actions", "rewards", "returns_to_go"):
        np.testing.assert_array_equal(getattr(again, name), getattr(part, name))
    for name in ("episode_lengths", "episode_returns", "terminated", "truncated"):
        np.testing.assert_array_equal(getattr(again, name), getattr(part, name))
    assert (again.action_space, again.env_id) == (whole.action_space, "Walker2d-v5")
    with pytest.raises(OSError, match=r"part\.npz/x\.npz"):
        part.save(path.parent / "part.npz" / "x")
    np.savez(path, **arrays(env_id=np.array(3)))
    with pytest.raises(DatasetError, match=r"env_id holds int64 .* the id of an environment is expected"):
        load_flat(path)


def test_damaged_and_missing_files(path, tmp_path):
    whole = write(path).read_bytes()
    np.savez_compressed(path, **arrays())
    compressed = bytearray(path.read_bytes())
    compressed[150:180] = bytes(30)
    for content in (b"", b"no archive", whole[:-200], compressed):
        path.write_bytes(content)
        with pytest.raises(DatasetError, match=r"episodes.npz: .*cannot be read"):
            load_flat(path)
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(DatasetError, match=r"episodes.npz: cannot be read .*not a zip file"):
        load_flat(path)
    with pytest.raises(DatasetError, match=r"none.npz does not exist; the path of a file of flat arrays"):
        load_dataset(tmp_path / "none.npz")


def test_a_cache_holds_the_same_and_a_model_learns_from_it(path, tmp_path):
    write(path)
    cached = load_dataset(path, cache_dir=tmp_path / "cache")
    np.testing.assert_array_equal(cached.observations, load_dataset(path).observations)
    options = dict(dataset_kwargs={"observation_keys": ["observations"], "env_id": "Pusher-v5"}, device="cpu")
    model = DT("MultiInputPolicy", dataset=str(path), policy_kwargs=dict(embed_dim=8, n_layers=1), **options).learn(2)
    assert model.buffer.env_id == "Pusher-v5"
