"""`sb3-dtfm export`: a trained policy as one ONNX file."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.cli.literals import key_value
from sb3_dtfm.files import read_configuration
from sb3_dtfm.finetuning import FinetunedDTFM


def main(argv: Sequence[str]) -> None:
    """
    Run `sb3-dtfm export`.

    :param argv: its arguments
    """
    parser = argparse.ArgumentParser(
        prog="sb3-dtfm export",
        description="Write a policy of dt or dtfm into one ONNX file, which acts without this package and PyTorch.",
    )
    parser.add_argument("model", metavar="MODEL", help="zip file, or folder of a run of `train`")
    parser.add_argument("--output", "-o", default="policy.onnx", metavar="FILE", help="policy.onnx by default")
    parser.add_argument("--env", metavar="ENV", help="Gymnasium id, for the file's metadata")
    parser.add_argument("--target-return", type=float, metavar="R", help="in reward units, for the file's metadata")
    parser.add_argument(
        "--acting",
        nargs="+",
        default=[],
        type=key_value,
        metavar="KEY:VALUE",
        help="way of acting, for example flow_steps:10 or kv_cache:True; as saved by default",
    )
    options = parser.parse_args(argv)
    path = find_model(options.model)
    configuration = read_configuration(path)
    algorithm = str(configuration.get("algorithm"))
    if algorithm.lower() not in ALGORITHMS:
        raise ValueError(f"{path} was saved by {algorithm}; {' and '.join(ALGORITHMS)} can be exported.")
    finetuned = dict(configuration.get("attributes") or {}).get("online_actor") is not None
    model = (FinetunedDTFM if finetuned else ALGORITHMS[algorithm.lower()]).load(path, device="cpu")
    model.policy.set_acting(**dict(options.acting))
    model.export(options.output, options.env, options.target_return)
    print(f"Policy: {options.output}")


def find_model(model: str | Path) -> Path:
    """
    :param model: zip file, or folder of an RL-Zoo run, whose last model is taken
    :raises FileNotFoundError: no such file, or no run of one task
    """
    path = Path(model)
    if not path.is_dir():
        return path
    names = [settings.parent.name for settings in path.glob("*/config.yml")]
    if len(names) != 1:
        raise FileNotFoundError(f"{path} is no folder of a run; expected that, or a model's zip file.")
    return path / f"{names[0]}.zip"
