"""LeRobot's cameras: images in Parquet files, and videos that PyAV has written."""

import io
import json
import shutil
import sys

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

from sb3_dtfm import DT
from sb3_dtfm.data import DatasetError, load_dataset
from sb3_dtfm.envs import resize_image

LENGTHS, FPS, SIZE = [3, 6, 4], 10, (48, 64)
CAMERA, STATE = "observation.images.top", "observation.state"


def pictures(first, n):
    """Smooth ones, so that codecs change them little; brighter from step to step, and no two sides alike."""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    return [
        np.stack([4 * rows, 3 * columns, np.full_like(rows, 15 * (first + i))], axis=2).astype(np.uint8) for i in range(n)
    ]


def png(image):
    file = io.BytesIO()
    Image.fromarray(image).save(file, "PNG")
    return file.getvalue()


def write_video(path, frames):
    """As MPEG-4 with a frame every tenth of a second, the key frames far apart."""
    av = pytest.importorskip("av")
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=FPS)
        stream.height, stream.width, stream.pix_fmt, stream.bit_rate = *SIZE, "yuv420p", 10**7
        stream.gop_size = 12
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())


def write(folder, version="v2.1", kind="video", shape=(*SIZE, 3)):
    """Three episodes: one file each, as in 2.1, or one for all, as in 3.0."""
    n, images = sum(LENGTHS), pictures(0, sum(LENGTHS))
    episodes, frames = np.repeat(np.arange(3), LENGTHS), np.concatenate([np.arange(length) for length in LENGTHS])
    numbers = {
        STATE: np.random.default_rng(0).normal(size=(n, 2)), "action": np.linspace(-1, 1, n)[:, None],
        "timestamp": (frames / FPS).astype(np.float32), "frame_index": frames, "episode_index": episodes,
    }  # fmt: skip
    features = {name: {"dtype": str(v.dtype), "shape": list(v.shape[1:]) or [1]} for name, v in numbers.items()}
    features[CAMERA] = {"dtype": kind, "shape": list(shape)}
    told = {"codebase_version": version, "total_frames": n, "total_episodes": 3, "fps": FPS, "features": features}
    for part in ("meta/episodes", "data"):
        (folder / part).mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(told))
    columns = {name: list(values) for name, values in numbers.items()}
    if kind == "image":
        columns[CAMERA] = [{"bytes": png(image), "path": None} for image in images]
    stops = np.cumsum(LENGTHS) if version == "v2.1" else [n]
    for number, stop in enumerate(stops):
        start = stops[number - 1] if number else 0
        table = pa.table({name: values[start:stop] for name, values in columns.items()})
        pq.write_table(table, folder / "data" / f"{number}.parquet", row_group_size=4)
        if kind == "video":
            chunk = f"chunk-000/{CAMERA}/episode_00000{number}" if version == "v2.1" else f"{CAMERA}/chunk-000/file-000"
            write_video(folder / "videos" / f"{chunk}.mp4", images[start:stop])
    if version == "v3.0":
        begins = {f"videos/{CAMERA}/from_timestamp": np.cumsum([0, *LENGTHS[:-1]]) / FPS, "episode_index": np.arange(3)}
        files = {f"videos/{CAMERA}/{name}_index": [0] * 3 for name in ("chunk", "file")}
        pq.write_table(pa.table({**begins, **files}), folder / "meta" / "episodes" / "file-000.parquet")
    return np.stack(images)


@pytest.mark.parametrize("kind", ["image", "video"])
@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_a_step_sees_the_frame_of_its_time(version, kind, tmp_path):
    images = write(tmp_path / "arm", version, kind)
    buffer = load_dataset(tmp_path / "arm")
    found = buffer.own(CAMERA).numpy()
    assert (found.shape, found.dtype) == ((13, *SIZE, 3), np.uint8)
    difference = np.abs(found.astype(int) - images)
    assert difference.mean() < 4.0 if kind == "video" else not difference.any(), "upright, in its order, red first"
    assert (np.diff(found[:, 20, 30, 2].astype(int)) > 8).all(), "no frame twice"
    assert buffer.observations.shape == (13, 2)
    some = load_dataset(tmp_path / "arm", observation_keys={"pixels": CAMERA}, episodes=[2], cache_dir=tmp_path / "cache")
    np.testing.assert_array_equal(some.own("pixels"), found[9:])
    assert some.observations.tolist() == [[0.0]] * 4
    without = load_dataset(tmp_path / "arm", observation_keys=[STATE])
    assert without.image_spaces == {}
    small = load_dataset(tmp_path / "arm", image_size=(24, 32))
    np.testing.assert_array_equal(small.own(CAMERA)[5], resize_image(found[5], (24, 32)))
    assert DT("MultiInputPolicy", dataset=small, device="cpu").policy.image_spaces[CAMERA].shape == (3, 24, 32)


def test_two_cameras_whose_videos_lie_in_several_files(tmp_path):
    """In format 3.0 an episode names the file of each of its videos."""
    folder, other = tmp_path / "arm", "observation.images.hand"
    images = write(folder, "v3.0")
    told = json.loads((folder / "meta" / "info.json").read_text())
    told["features"][other] = told["features"][CAMERA]
    (folder / "meta" / "info.json").write_text(json.dumps(told))
    path = folder / "meta" / "episodes" / "file-000.parquet"
    episodes = pq.read_table(path).to_pydict()
    for number, (start, stop) in enumerate([(0, 3), (3, 13)]):  # the second file holds two episodes
        write_video(folder / "videos" / f"{other}/chunk-00{number}/file-00{1 - number}.mp4", list(255 - images[start:stop]))
    episodes |= {
        f"videos/{other}/chunk_index": [0, 1, 1],
        f"videos/{other}/file_index": [1, 0, 0],
        f"videos/{other}/from_timestamp": [0.0, 0.0, LENGTHS[1] / FPS],
    }
    pq.write_table(pa.table(episodes), path)
    buffer = load_dataset(folder)
    assert set(buffer.image_spaces) == {CAMERA, other}
    for camera, expected in ((CAMERA, images), (other, 255 - images)):
        assert np.abs(buffer.own(camera).numpy().astype(int) - expected).mean() < 4.0


def test_pyav_is_named_where_it_is_missing(tmp_path, monkeypatch):
    write(tmp_path / "arm")
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(ImportError, match=r'needs PyAV: pip install "sb3-dtfm\[video\]"'):
        load_dataset(tmp_path / "arm")


def test_maps_of_numbers_are_not_read_as_vectors(tmp_path):
    """A map of depth, say; who names it gets its numbers side by side."""
    folder, depth = tmp_path / "arm", "observation.depth"
    write(folder, kind="image")
    told = json.loads((folder / "meta" / "info.json").read_text())
    told["features"][depth] = {"dtype": "float32", "shape": [20, 16]}
    (folder / "meta" / "info.json").write_text(json.dumps(told))
    for number, n_steps in enumerate(LENGTHS):
        table = pq.read_table(folder / "data" / f"{number}.parquet")
        maps = np.random.default_rng(number).random((n_steps, 20, 16))
        pq.write_table(table.append_column(depth, pa.array(maps.tolist())), folder / "data" / f"{number}.parquet")
    with pytest.warns(UserWarning, match=r"neither vectors nor images, and not read: observation.depth \(float32\)"):
        assert load_dataset(folder).observations.shape == (13, 2)
    assert load_dataset(folder, observation_keys=[depth]).observations.shape == (13, 320)
    told["features"][depth]["shape"] = [20, [2], None]
    (folder / "meta" / "info.json").write_text(json.dumps(told))
    assert load_dataset(folder).observations.shape == (13, 322), "no map, as far as is told"


@pytest.mark.parametrize(("rows", "n_found"), [([0, 1], 0), ([0, 2, 1, 2], 2)])
def test_each_episode_has_one_row_of_where_it_is_in_a_video(rows, n_found, tmp_path):
    """In any order; others than the one that has none or several can be read."""
    images = write(tmp_path / "arm", "v3.0")
    path = tmp_path / "arm" / "meta" / "episodes" / "file-000.parquet"
    pq.write_table(pq.read_table(path).take(rows), path)
    with pytest.raises(DatasetError, match=f"arm, episode 2: meta/episodes has {n_found} rows of it, expected one"):
        load_dataset(tmp_path / "arm")
    found = load_dataset(tmp_path / "arm", episodes=[1]).own(CAMERA).numpy()
    assert np.abs(found.astype(int) - images[3:9]).mean() < 4.0


def test_steps_in_any_order_find_their_images(tmp_path):
    """Also where an episode lies in several files."""
    images = write(tmp_path / "arm", kind="image")
    whole = pa.concat_tables(pq.read_table(tmp_path / "arm" / "data" / f"{number}.parquet") for number in range(3))
    shuffled = whole.take(np.random.default_rng(0).permutation(len(whole)))
    for number, (start, stop) in enumerate([(0, 5), (5, 6), (6, 13)]):
        pq.write_table(
            shuffled.slice(start, stop - start), tmp_path / "arm" / "data" / f"{number}.parquet", row_group_size=3
        )
    np.testing.assert_array_equal(load_dataset(tmp_path / "arm").own(CAMERA), images)


def test_images_in_files_of_their_own(tmp_path):
    images = write(tmp_path / "arm", kind="image")
    path = tmp_path / "arm" / "data" / "1.parquet"
    table = pq.read_table(path).drop_columns(CAMERA)
    (tmp_path / "arm" / "images").mkdir()
    for number in range(6):
        (tmp_path / "arm" / "images" / f"{number}.png").write_bytes(png(images[3 + number]))
    beside = [{"bytes": None, "path": f"images/{number}.png"} for number in range(6)]
    pq.write_table(table.append_column(CAMERA, [beside]), path)
    np.testing.assert_array_equal(load_dataset(tmp_path / "arm").own(CAMERA), images)
    outside = [{"bytes": None, "path": "../other.png"}] * 6
    (tmp_path / "other.png").write_bytes(png(images[0]))
    pq.write_table(table.append_column(CAMERA, [outside]), path)
    with pytest.raises(DatasetError, match=r"arm, episode 1: observation.images.top: there is no image .*\.\./other.png"):
        load_dataset(tmp_path / "arm")


def test_unfit_images_are_named(tmp_path):
    write(tmp_path / "arm", kind="image", shape=(50, 64, 3))
    with pytest.raises(DatasetError, match=r"episode 0: .*top, step 0: the image is RGB of 48 x 64 pixels, expected \(50"):
        load_dataset(tmp_path / "arm")
    with pytest.raises(
        DatasetError, match=r"no feature 'wrist' of numbers or images, only action, .*, observation.images.top"
    ):
        load_dataset(tmp_path / "arm", observation_keys=["wrist"])
    with pytest.raises(ValueError, match="image_size must be height and width, pixels, got 96"):
        load_dataset(tmp_path / "arm", image_size=96)
    shutil.rmtree(tmp_path / "arm")
    write(tmp_path / "arm", kind="image", shape=(3, *SIZE))
    assert load_dataset(tmp_path / "arm").image_spaces[CAMERA].shape == (*SIZE, 3)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_missing_and_damaged_videos_are_named(version, tmp_path):
    images = write(tmp_path / "arm", version)
    *_, path = sorted((tmp_path / "arm" / "videos").rglob("*.mp4"))
    episode = {"v2.1": 2, "v3.0": 0}[version]
    content, where = path.read_bytes(), rf"arm, episode {episode}: observation.images.top"
    write_video(path, images[:2])
    with pytest.raises(DatasetError, match=rf"{where}, step 2: .*{path.name} has no frame at 0.200 s, only at 0.100 s"):
        load_dataset(tmp_path / "arm")
    damaged = bytearray(content)
    middle = (content.index(b"mdat") + content.index(b"moov")) // 2
    damaged[middle - 200 : middle + 200] = bytes(400)
    path.write_bytes(damaged)
    with pytest.raises(DatasetError, match=rf"episode \d: .*, step \d: .*{path.name}, the frame at .* s: cannot be read"):
        load_dataset(tmp_path / "arm")
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(
        DatasetError, match=rf"{where}: .*{path.name}(: cannot be read .*the video is no MP4| holds no video)"
    ):
        load_dataset(tmp_path / "arm")
    path.unlink()
    with pytest.raises(DatasetError, match=rf"{where}: there is no video .*{path.name}"):
        load_dataset(tmp_path / "arm")


def test_a_path_of_the_videos_is_no_way_out_of_the_folder(tmp_path):
    write(tmp_path / "arm")
    info = tmp_path / "arm" / "meta" / "info.json"
    content = json.loads(info.read_text())
    for template, message in {
        "../{video_key}.mp4": r"there is no video .*arm/\.\./observation.images.top.mp4",
        "videos/{video_key.__class__}.mp4": r"there is no video .*arm/videos/\{video_key.__class__\}.mp4",
        "videos/{wrist}.mp4": "cannot be read .KeyError: 'wrist'",
    }.items():
        info.write_text(json.dumps({**content, "video_path": template}))
        with pytest.raises(DatasetError, match=rf"arm, episode 0: observation.images.top: .*{message}"):
            load_dataset(tmp_path / "arm")
