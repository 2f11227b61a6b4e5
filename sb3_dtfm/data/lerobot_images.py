"""The cameras of LeRobot datasets: images in Parquet files, or videos."""

import functools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sb3_dtfm.arguments import COUNT, POSITIVE
from sb3_dtfm.data.arrow import as_numbers, import_pyarrow
from sb3_dtfm.data.cache import files_below
from sb3_dtfm.data.image_files import decode_images
from sb3_dtfm.data.trajectories import DatasetError, check_size, wrap_dataset_errors
from sb3_dtfm.data.videos import read_frames
from sb3_dtfm.envs.observation_spaces import CHANNELS

INFO, DATA, EPISODES = "meta/info.json", "data", "meta/episodes"
EPISODE, FRAME, TIME = "episode_index", "frame_index", "timestamp"
IMAGE, VIDEO = "image", "video"
# Default paths of the videos in formats 2 and 3.
PATHS = {
    "2": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
    "3": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
}
FIELD = re.compile(r"\{(\w+)(?::0(\d)d)?\}")
# Encoded images that are in memory together.
BATCH = 16


class Columns:
    """
    The columns of all Parquet files below a folder.

    :param folder: folder of the dataset
    :param part: path of a folder inside of it
    :param names: names of the columns, which are all read now
    :param source: name of the dataset, for messages
    :ivar numbers: arrays (N, .) by column name
    :ivar files: paths of the files, with their numbers of rows
    :ivar n_stored: size of the files, bytes
    :raises DatasetError: no file, a column that is missing or holds no numbers, or a damaged file
    """

    def __init__(self, folder: Path, part: str, names: list[str], source: str) -> None:
        paths = [path for path in files_below(folder, part) if path.suffix == ".parquet"]
        if not paths:
            raise DatasetError(f"{source}: there is no parquet file below {part}.")
        pyarrow = import_pyarrow(source)
        self.n_stored = sum(path.stat().st_size for path in paths)
        self.files: list[tuple[Path, int]] = []
        parts: list[dict[str, np.ndarray]] = []
        n_numbers = 0
        for path in paths:
            with wrap_dataset_errors(str(path)), pyarrow.parquet.ParquetFile(path) as file:
                missing = sorted(set(names) - set(file.schema_arrow.names))
                if missing:
                    raise DatasetError(f"{path}: has no column {', '.join(missing)}.")
                self.files.append((path, file.metadata.num_rows))
                groups = [file.metadata.row_group(i) for i in range(file.metadata.num_row_groups)]
                n_numbers += sum(group.column(i).num_values for group in groups for i in range(group.num_columns))
                check_size(8 * n_numbers, self.n_stored, f"{source}: {sum(n for _, n in self.files)} frames")
                table = file.read(columns=names)
                table.validate(full=True)
                found = {name: as_numbers(table[name].combine_chunks(), f"{path}: {name}") for name in names}
                parts.append({name: values.reshape(len(values), -1) for name, values in found.items()})
        with wrap_dataset_errors(source):
            self.numbers = {name: np.concatenate([each[name] for each in parts]) for name in names}

    def __len__(self) -> int:
        return sum(n_rows for _, n_rows in self.files)


class Cameras:
    """
    Reads images episode by episode.

    :param folder: folder of the dataset
    :param info: content of its `meta/info.json`
    :param cameras: names of the image or video features to read
    :param files: the Parquet files of its steps, with their numbers of rows
    :param size: (height, width) that all images are resized to; None keeps their size
    :param source: name of the dataset, for messages
    :raises DatasetError: sizes, the frame rate, or the starts of episodes in a video are missing
    """

    def __init__(
        self,
        folder: Path,
        info: dict[str, Any],
        cameras: list[str],
        files: list[tuple[Path, int]],
        size: tuple[int, int] | None,
        source: str,
    ) -> None:
        self._folder, self._info, self._files, self._size, self._source = folder, info, files, size, source
        self._stops = np.cumsum([n_rows for _, n_rows in files])  # of each file's rows among those of all
        self._shapes = {camera: _shape(info["features"][camera]["shape"], f"{source}: {camera}") for camera in cameras}
        self._videos = [camera for camera in cameras if info["features"][camera]["dtype"] == VIDEO]
        self._begins: Columns | None = None
        self._rows_of: dict[float, list[int]] = {}  # by episode
        if not self._videos:
            return
        if not POSITIVE.accepts(info.get("fps")):
            raise DatasetError(f"{source}: {INFO}: fps is {info.get('fps')!r:.20}; {POSITIVE} is expected.")
        self._files_there = set(files_below(folder, "videos")) if (folder / "videos").is_dir() else set()
        if info["codebase_version"].startswith("v3"):
            parts = ("chunk_index", "file_index", "from_timestamp")
            names = [EPISODE, *(f"videos/{camera}/{each}" for camera in self._videos for each in parts)]
            self._begins = Columns(folder, EPISODES, names, source)
            for row, episode in enumerate(self._begins.numbers[EPISODE][:, 0].tolist()):
                self._rows_of.setdefault(episode, []).append(row)

    @functools.cached_property
    def _image_files(self) -> set[Path]:
        """All files of the folder, listed once, and only where a dataset names image files: it has one for each step."""
        return set(files_below(self._folder))

    def read(self, camera: str, episode: int, rows: np.ndarray, times: np.ndarray) -> np.ndarray:
        """
        :param camera: name of one of the cameras
        :param episode: number of the episode
        :param rows: (T,) rows of the images, counted over all Parquet files
        :param times: (T,) seconds from the beginning of the episode
        :return: (T, height, width, channels) uint8
        :raises DatasetError: missing or damaged, or of another shape; names file, episode and step
        """
        where = f"{self._source}, episode {episode}: {camera}"
        if camera not in self._videos:
            return decode_images(self._encoded(camera, rows, where), len(rows), self._shapes[camera], where, self._size)
        with wrap_dataset_errors(f"{where}: {INFO} or {EPISODES}"):
            path, begin = self._video(camera, episode)
        if path not in self._files_there:
            raise DatasetError(f"{where}: there is no video {path}.")
        return read_frames(path, begin + times, self._info["fps"], self._shapes[camera], self._size, where)

    def _video(self, camera: str, episode: int) -> tuple[Path, float]:
        """The video's file, and the episode's start in it, seconds."""
        version, begin = self._info["codebase_version"][1], 0.0
        values: dict[str, Any] = {"video_key": camera, EPISODE: episode}
        if self._begins is None:
            values["episode_chunk"] = episode // self._info.get("chunks_size", 1000)
        else:
            columns = self._begins.numbers
            rows = self._rows_of.get(episode, [])
            if len(rows) != 1:
                raise DatasetError(
                    f"{self._source}, episode {episode}: {EPISODES} has {len(rows)} rows of it, expected one."
                )
            row = rows[0]
            values.update({name: int(columns[f"videos/{camera}/{name}"][row, 0]) for name in ("chunk_index", "file_index")})
            begin = float(columns[f"videos/{camera}/from_timestamp"][row, 0])
        template = self._info.get("video_path") or PATHS[version]
        # Not str.format, which would look into objects for whoever wrote the template.
        path = FIELD.sub(lambda found: str(values[found[1]]).zfill(int(found[2] or 0)), template)
        return self._folder / path, begin

    def _encoded(self, camera: str, rows: np.ndarray, where: str) -> list[bytes]:
        """The bytes of some images, whose batches are read one by one: a small file can refer to one image many times."""
        pyarrow = import_pyarrow(self._source)
        found: dict[int, Any] = {}
        files = np.searchsorted(self._stops, rows, side="right")  # of each row
        for number in np.unique(files):
            path, n_rows = self._files[number]
            start = int(self._stops[number]) - n_rows
            with wrap_dataset_errors(f"{where}: {path}"), pyarrow.parquet.ParquetFile(path) as file:
                here = _rows(file, camera, rows[files == number] - start)
                found.update((start + row, image) for row, image in here)
        return [self._content(found[row], where) for row in rows.tolist()]

    def _content(self, image: Any, where: str) -> bytes:
        """:param image: the bytes, or a dictionary of them and of the path of a file"""
        if isinstance(image, dict) and image.get("bytes") is None:
            path = self._folder / str(image.get("path"))
            if path not in self._image_files:
                raise DatasetError(f"{where}: there is no image {path}.")
            return path.read_bytes()
        return image["bytes"] if isinstance(image, dict) else image


def _rows(file: Any, camera: str, rows: np.ndarray) -> Iterator[tuple[int, Any]]:
    """
    :param file: an open Parquet file
    :param rows: (T,) rows of the file
    :return: pairs of a row and its image
    """
    start = 0
    for number in range(file.num_row_groups):
        stop = start + file.metadata.row_group(number).num_rows
        if ((rows >= start) & (rows < stop)).any():
            first = start
            for batch in file.iter_batches(BATCH, row_groups=[number], columns=[camera]):
                here = rows[(rows >= first) & (rows < first + len(batch))].tolist()
                yield from ((row, batch.column(0)[row - first].as_py()) for row in here)
                first += len(batch)
        start = stop


def _shape(shape: Any, where: str) -> tuple[int, ...]:
    """(height, width, channels), whichever order the dataset's description has."""
    if not (isinstance(shape, list) and len(shape) == 3 and all(COUNT.accepts(each) and each for each in shape)):
        raise DatasetError(f"{where} has shape {shape!r:.40}, expected height, width and channels.")
    channels_first = shape[0] in CHANNELS and shape[2] not in CHANNELS
    return tuple(shape[1:] + shape[:1] if channels_first else shape)
