"""`sb3-dtfm push`: a trained model, its card and a video, to Hugging Face's hub or into a folder."""

import argparse
import contextlib
import json
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from huggingface_sb3 import EnvironmentName
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.files import read_run, replacing
from sb3_dtfm.recording.loading import AgentFiles, find_agent
from sb3_dtfm.zoo import hub
from sb3_dtfm.zoo.arguments import at_least, import_packages
from sb3_dtfm.zoo.commands import FoundModel
from sb3_dtfm.zoo.registration import register
from sb3_dtfm.zoo.rendering import RenderingError
from sb3_dtfm.zoo.video import add_model_arguments, chosen_model, film


def main(argv: Sequence[str]) -> None:
    """
    Run `sb3-dtfm push`.

    :param argv: its arguments
    """
    options = _parser().parse_args(argv)
    repo_id = hub.repository_id(options)
    register()
    import_packages(options.gym_packages)
    model = chosen_model(options)
    with _folder(options.repo_folder) as folder:
        write_repository(folder, repo_id, model, options)
        if options.repo_folder is None:
            print(f"Repository: {hub.upload(folder, repo_id, options.commit_message)}")
        else:
            print(f"Repository: {folder}")


def write_repository(folder: Path, repo_id: str, model: FoundModel, options: argparse.Namespace) -> None:
    """
    Write everything that is uploaded.

    :param folder: folder to write into
    :param repo_id: organisation/name
    :param model: model of a run
    :param options: arguments of the command
    """
    env_name: EnvironmentName = options.env
    hyperparams = read_run(Path(model.run, env_name))
    agent = find_agent(model.run, env_name.gym_id)
    settings = hub.Settings(options.algo, env_name.gym_id, hub.target_return_of(hyperparams), agent.env_kwargs)
    settings.write(folder)
    hub.copy_model(Path(model.path), folder / settings.model_name.filename)
    result = evaluate(model, agent, options)
    with replacing(folder / hub.RESULTS) as path:
        path.write_text(json.dumps(result._asdict(), indent=1) + "\n")
    has_video = not options.no_render and _write_video(folder / hub.VIDEO, model, options)
    hub.write_card(folder, repo_id, settings, hyperparams, result, has_video)


def evaluate(model: FoundModel, agent: AgentFiles, options: argparse.Namespace) -> hub.Result:
    """
    Evaluate the model as its file has it.

    :param model: model of the run
    :param agent: the model's files, which say what its environment was in training
    :param options: arguments of the command
    """
    env = make_vec_env(options.env.gym_id, seed=options.seed, env_kwargs=agent.env_kwargs, wrapper_class=agent.wrapper)
    try:
        trained = ALGORITHMS[options.algo].load(model.path, device="cpu")
        trained.check_controller(env)
        mean, deviation = evaluate_policy(trained, env, n_eval_episodes=options.n_eval_episodes)
    finally:
        env.close()
    return hub.Result(float(mean), float(deviation), options.n_eval_episodes)  # type: ignore[arg-type]


def _write_video(path: Path, model: FoundModel, options: argparse.Namespace) -> bool:
    """Write a video, and return whether this machine can draw one."""
    arguments = [
        "--algo",
        options.algo,
        "--env",
        options.env.gym_id,
        "-n",
        str(options.n_timesteps),
        "--seed",
        str(options.seed),
    ]
    try:
        film([model], arguments, path)
    except RenderingError as error:
        print(f"No video: {error}")
        return False
    return True


@contextlib.contextmanager
def _folder(given: Path | None) -> Iterator[Path]:
    """The given folder, or one that is gone in the end."""
    if given is not None:
        given.mkdir(parents=True, exist_ok=True)
        yield given
        return
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sb3-dtfm push",
        description="Upload a trained model of dt or dtfm to Hugging Face's hub, with its card, an evaluation and a video.",
        allow_abbrev=False,
    )
    add_model_arguments(parser)
    hub.add_repository_arguments(parser)
    argument = parser.add_argument
    argument("-m", "--commit-message", default="Upload of sb3-dtfm", metavar="TEXT", help="message of the upload")
    argument("-n", "--n-timesteps", type=at_least(1), default=1000, metavar="N", help="steps of the video, 1000 by default")
    argument("--no-render", action="store_true", help="no video")
    argument(
        "--n-eval-episodes", type=at_least(1), default=10, metavar="N", help="episodes of the evaluation, 10 by default"
    )
    argument("--seed", type=int, default=0, help="seed of the evaluation and the video, 0 by default")
    argument("--gym-packages", nargs="+", default=[], metavar="MODULE", help="modules to import first, which register tasks")
    return parser
