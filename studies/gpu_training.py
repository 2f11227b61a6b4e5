"""
Train DTFM at the paper's size on one GPU, as fast as it goes, evaluated by other processes meanwhile.

    python studies/gpu_training.py --dataset local/halfcheetah/expert-v0 --env HalfCheetah-v5 --target-return 12000

First measures: no synchronisation inside the loop (one would raise), milliseconds a step, the share of the GPU's
peak that matrix products take (model FLOP utilisation), and how long its kernels take by torch's profiler. Then trains;
a checkpoint every 1,000 steps is evaluated on the CPU's other cores, and `evaluations.jsonl` gets a line for each.
`--device cpu --compile` with a small `--width`, `--layers` and `--steps` goes the same way without a GPU.
"""

import argparse
import json
import multiprocessing
import os
import time
from concurrent.futures import Future, ProcessPoolExecutor
from pathlib import Path

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

from sb3_dtfm import DTFM
from sb3_dtfm.envs import ReturnToGoWrapper

WARM_UP_STEPS, MEASURED_STEPS, PROFILED_STEPS = 30, 200, 10


def evaluate(checkpoint: str, env_id: str, target_return: float, n_episodes: int, seed: int) -> dict[str, object]:
    """Returns of a checkpoint's episodes; runs in a process of its own, on one core."""
    th.set_num_threads(1)
    model = DTFM.load(checkpoint, device="cpu")
    model.policy.set_acting(kv_cache=True)
    vec_env = make_vec_env(
        env_id, n_episodes, seed, wrapper_class=ReturnToGoWrapper, wrapper_kwargs=dict(target_return=target_return)
    )
    returns, lengths = evaluate_policy(model, vec_env, n_episodes, return_episode_rewards=True)
    return {"step": model.num_timesteps, "returns": returns, "lengths": lengths}


class EvaluateElsewhere(BaseCallback):
    """Save the model at an interval and hand the file to other processes: training does not wait for an episode."""

    def __init__(self, folder: Path, interval: int, pool: ProcessPoolExecutor, options: argparse.Namespace) -> None:
        super().__init__()
        self.folder, self.interval, self.pool, self.options = folder, interval, pool, options
        self.futures: list[Future] = []

    def _on_step(self) -> bool:
        if self.num_timesteps % self.interval == 0:
            checkpoint = self.folder / f"{self.num_timesteps}_steps.zip"
            self.model.save(checkpoint)
            arguments = (self.options.env, self.options.target_return, self.options.episodes, self.options.seed)
            self.futures.append(self.pool.submit(evaluate, str(checkpoint), *arguments))
            self.futures[-1].add_done_callback(self._write)
        return True

    def _write(self, future: Future) -> None:
        with open(self.folder / "evaluations.jsonl", "a") as file:
            file.write(json.dumps(future.result()) + "\n")


def matrix_flops(model: DTFM) -> float:
    """Floating-point operations of a gradient step's matrix products, counted by torch."""
    generator = th.Generator(model.device).manual_seed(0)
    batch = model.buffer.sample(model.batch_size, model.context_length, generator)
    with FlopCounterMode(display=False) as counter:
        loss, _ = model.compute_loss(batch, *model.policy.network.draw_noise(batch, generator))
        loss.backward()
    return counter.get_total_flops()


def print_kernels(model: DTFM) -> None:
    """Print how many kernels a step has and how long the GPU is busy with them."""
    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as profiler:
        model.learn(PROFILED_STEPS, log_interval=None)
        th.cuda.synchronize()
    kernels = [
        each for each in profiler.key_averages() if each.device_type == DeviceType.CUDA and not each.is_user_annotation
    ]
    count, busy_us = sum(each.count for each in kernels), sum(each.self_device_time_total for each in kernels)
    print(f"{count / PROFILED_STEPS:.0f} kernels a step, {busy_us / 1e3 / PROFILED_STEPS:.2f} ms a step", flush=True)


def measure(model: DTFM, peak_flops: float) -> None:
    """Print milliseconds a step and model FLOP utilisation of the learn loop, compilation left out."""
    on_gpu = model.device.type == "cuda"
    stamps = []

    def stamp(*_: object) -> bool:
        if model.num_timesteps in (WARM_UP_STEPS, WARM_UP_STEPS + MEASURED_STEPS):
            if on_gpu:
                th.cuda.set_sync_debug_mode("default")
                th.cuda.synchronize()
                # Between the stamps, whatever waits for the GPU raises.
                th.cuda.set_sync_debug_mode("error" if model.num_timesteps == WARM_UP_STEPS else "default")
            stamps.append(time.perf_counter())
        return True

    model.learn(WARM_UP_STEPS + MEASURED_STEPS, stamp, log_interval=None)
    seconds = (stamps[1] - stamps[0]) / MEASURED_STEPS
    flops = matrix_flops(model)
    if on_gpu:
        print_kernels(model)
    print(
        f"{seconds * 1e3:.2f} ms a step, {flops / 1e9:.0f} GFLOP of matrix products a step, "
        f"model FLOP utilisation {flops / seconds / peak_flops:.1%} of {peak_flops / 1e12:.0f} TFLOP/s",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", required=True)
    parser.add_argument("--env", required=True)
    parser.add_argument("--target-return", type=float, required=True)
    parser.add_argument("--steps", type=int, default=150_000)
    parser.add_argument("--episodes", type=int, default=5)
    parser.add_argument("--evaluation-interval", type=int, default=1000)
    parser.add_argument("--batch-size", type=int, default=256)
    parser.add_argument("--width", type=int, default=256)
    parser.add_argument("--layers", type=int, default=10)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--compile", action=argparse.BooleanOptionalAction, help="on a GPU by default")
    parser.add_argument("--peak-tflops", type=float, default=989.0, help="of the device: an H100's in dense bfloat16")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, default=Path("gpu_training"))
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    arguments = dict(
        dataset=options.dataset,
        batch_size=options.batch_size,
        policy_kwargs=dict(embed_dim=options.width, n_layers=options.layers),
        compile=options.compile,
        device=options.device,
        seed=options.seed,
    )
    measure(DTFM("MultiInputPolicy", **arguments), options.peak_tflops * 1e12)
    if options.steps:
        model = DTFM("MultiInputPolicy", **arguments, tensorboard_log=str(options.folder), verbose=1)
        spawn = multiprocessing.get_context("spawn")  # a forked process must not touch the GPU
        start = time.perf_counter()
        with ProcessPoolExecutor(max(1, (os.cpu_count() or 2) - 1), spawn) as pool:
            elsewhere = EvaluateElsewhere(options.folder, options.evaluation_interval, pool, options)
            model.learn(options.steps, elsewhere, progress_bar=True)
            for future in elsewhere.futures:
                future.result()  # an evaluation that failed raises here
            print(f"{options.steps} steps in {(time.perf_counter() - start) / 60:.1f} minutes")
        model.save(options.folder / "final.zip")


if __name__ == "__main__":
    main()
