"""Frames of MP4 videos by their times."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sb3_dtfm.data.trajectories import DatasetError, wrap_dataset_errors
from sb3_dtfm.envs.cameras import resize_image


def read_frames(
    path: Path, times: np.ndarray, fps: float, shape: tuple[int, ...], size: tuple[int, int] | None, where: str
) -> np.ndarray:
    """
    The frames that a video shows at some times.

    :param path: an MP4 file
    :param times: (T,) seconds, ascending
    :param fps: frames per second; a time is shown by a frame at most half a frame's duration away
    :param shape: (height, width, 3) that the video must have
    :param size: (height, width) that its frames are resized to; None keeps their size
    :param where: the episode, for messages
    :return: (T, height, width, 3) uint8
    :raises ImportError: PyAV is not installed
    :raises DatasetError: the video is damaged, has another shape, or no frame at one of the times; names it and the step
    """
    try:
        import av
    except ImportError as error:
        raise ImportError(f'{path} needs PyAV: pip install "sb3-dtfm[video]"') from error
    images = np.empty((len(times), *(size or shape[:2]), 3), np.uint8)
    damaged = "the video is no MP4, or damaged or cut off"
    with wrap_dataset_errors(f"{where}: {path}", damaged), av.open(str(path), format="mp4") as container:
        if not container.streams.video:
            raise DatasetError(f"{where}: {path} holds no video; it is damaged or cut off.")
        stream = container.streams.video[0]
        if (getattr(stream, "height", 0), getattr(stream, "width", 0), 3) != shape:
            raise DatasetError(f"{where}: {path} shows {stream}, expected {shape}.")
        stream.codec_context.options = {"err_detect": "explode"}
        container.seek(int(max(0.0, times[0]) / stream.time_base), stream=stream)
        frames, last = container.decode(stream), -np.inf
        for step, time in enumerate(times):
            while last < time - 0.5 / fps:
                with wrap_dataset_errors(f"{where}, step {step}: {path}, the frame at {time:.3f} s", damaged):
                    frame = _next(frames)
                if frame is None or frame.time > time + 0.5 / fps:
                    beside = "" if frame is None else f" and {frame.time:.3f}"
                    raise DatasetError(
                        f"{where}, step {step}: {path} has no frame at {time:.3f} s, only at {last:.3f}{beside} s."
                    )
                last, image = frame.time, None
            image = resize_image(frame.to_ndarray(format="rgb24"), size) if image is None else image
            images[step] = image
    return images


def _next(frames: Iterator[Any]) -> Any:
    """The next frame, None after the last one."""
    frame = next(frames, None)
    if frame is not None and frame.is_corrupt:
        raise ValueError("the frame is damaged")
    return frame
