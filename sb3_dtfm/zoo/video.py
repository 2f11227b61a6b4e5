"""Videos of trained models, by RL-Zoo's `record_video`, as an MP4 or a GIF."""

import argparse
import contextlib
import io
import re
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
from huggingface_sb3 import EnvironmentName, ModelName
from imageio_ffmpeg import get_ffmpeg_exe

from sb3_dtfm.files import read_run, replacing
from sb3_dtfm.zoo.arguments import UsageError
from sb3_dtfm.zoo.commands import FoundModel, find_model, record_video
from sb3_dtfm.zoo.rendering import drawing

# Endings of files, with what ffmpeg makes of frames for each; a GIF's colours are chosen for the whole video.
FORMATS = {".mp4": "format=yuv420p", ".gif": "fps=10,split[a][b];[a]palettegen[colours];[b][colours]paletteuse"}
FONT = "DejaVuSans.ttf"


def models_of_training(run: Path, algo: str, env_name: EnvironmentName) -> list[FoundModel]:
    """
    All models of a run in the order of RL-Zoo's `record_training`: checkpoints by their steps, the last model, the best.

    :param run: the run's folder
    :param algo: algorithm of the run
    :param env_name: environment of the run
    """
    checkpoints = [(int(re.findall(r"\d+", path.name)[0]), path) for path in run.glob("rl_model_*_steps.zip")]
    found = [(f"checkpoint-{n_steps}", path) for n_steps, path in sorted(checkpoints)]
    found += [("final-model", run / f"{env_name}.zip"), ("best-model", run / "best_model.zip")]
    name = ModelName(algo, env_name)
    return [FoundModel(f"{prefix}-{name}", str(path), str(run)) for prefix, path in found if path.is_file()]


def film(models: Sequence[FoundModel], arguments: Sequence[str], output: Path) -> None:
    """
    Let models act, and write one video of all of them.

    :param models: models to film, at least one; where there are several, a title names the model of each part
    :param arguments: arguments of RL-Zoo's `record_video`, but for those that choose models and folders
    :param output: .mp4 or .gif file, replaced if it is there
    :raises UsageError: another ending
    :raises RenderingError: no picture can be drawn on this machine as it is
    """
    if output.suffix not in FORMATS:
        raise UsageError(f"{output}: a video ends in {' or '.join(FORMATS)}.")
    with tempfile.TemporaryDirectory() as folder, drawing():
        parts = []
        for i, model in enumerate(models):
            part = Path(folder, str(i))
            print(f"Filming {model.path}")
            with contextlib.redirect_stdout(io.StringIO()):  # it names files that do not stay
                own = [*with_env_kwargs(model, arguments), "--output-folder", str(part)]
                record_video(model, [*own, "--no-render"])  # else it draws twice
            parts.append(next(part.glob("*.mp4")))
        titles = [" ".join(model.prefix.split("-")[:2]) for model in models] if len(models) > 1 else []
        shutil.copy(Path(mpl.get_data_path(), "fonts", "ttf", FONT), folder)
        with replacing(output) as beside:
            _write(parts, titles, beside.resolve(), output.suffix, folder)


def with_env_kwargs(model: FoundModel, arguments: Sequence[str]) -> list[str]:
    """
    Arguments of `record_video` with those of the environment that the run's settings have, which it does not read itself.

    :param model: model of the run
    :param arguments: the user's arguments, whose own `--env-kwargs` count where both have one
    """
    runs = [read_run(path.parent) for path in Path(model.run).glob("*/config.yml")]  # none of an agent from elsewhere
    words = [f"{name}:{value!r}" for run in runs for name, value in (run.get("env_kwargs") or {}).items()]
    given = list(arguments)
    if words and "--env-kwargs" not in given:
        return [*given, "--env-kwargs", *words]
    place = given.index("--env-kwargs") + 1 if words else 0
    return [*given[:place], *words, *given[place:]]


def _write(parts: Sequence[Path], titles: Sequence[str], output: Path, ending: str, folder: str) -> None:
    """
    Write one video of several.

    :param titles: line for each part, or none at all
    :param folder: folder of the font
    """
    streams = [f"[{i}:v]null[v{i}]" for i in range(len(parts))]
    for i, title in enumerate(titles):
        look = "fontcolor=white:fontsize=24:box=1:boxcolor=black@0.5:boxborderw=5:x=(w-text_w)/2:y=12"
        streams[i] = f"[{i}:v]drawtext=fontfile={FONT}:text='{title}':{look}[v{i}]"
    joined = "".join(f"[v{i}]" for i in range(len(parts)))
    filters = ";".join([*streams, f"{joined}concat=n={len(parts)}[joined]", f"[joined]{FORMATS[ending]}"])
    inputs = [argument for part in parts for argument in ("-i", str(part))]
    command = [
        get_ffmpeg_exe(),
        "-y",
        "-loglevel",
        "error",
        *inputs,
        "-filter_complex",
        filters,
        "-f",
        ending[1:],
        str(output),
    ]
    ffmpeg = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if ffmpeg.returncode:
        raise OSError(f"ffmpeg could not write the video: {ffmpeg.stderr.strip()}")


def add_model_arguments(parser: argparse.ArgumentParser) -> None:
    """
    RL-Zoo's arguments that choose a model.

    :param parser: parser that gets them
    """
    argument = parser.add_argument
    argument("--algo", required=True, help="dt, dtfm, sac, ...")
    argument("--env", required=True, type=EnvironmentName, help="Gymnasium id")
    argument("-f", "--folder", default="logs", help="that train wrote to, logs by default")
    argument(
        "--exp-id", type=int, default=0, metavar="N", help="number of the run; the latest that has such a model by default"
    )
    argument("--load-best", action="store_true", help="the best model of the evaluations instead of the last one")
    argument("--load-checkpoint", metavar="STEPS", help="the checkpoint of so many steps")
    argument("--load-last-checkpoint", action="store_true", help="the last checkpoint")


def chosen_model(options: argparse.Namespace) -> FoundModel:
    """
    :param options: parsed arguments of :func:`add_model_arguments`
    :raises FileNotFoundError: no such run, or no such model in it
    """
    which = options.load_best, options.load_checkpoint, options.load_last_checkpoint
    return find_model(options.exp_id, options.folder, options.algo, options.env, *which)
