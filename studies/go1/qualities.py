"""
Does return-to-go choose how fast a robot walks? Three teachers, who are told a third, two thirds and all of the command, lie
in one dataset; a student learns from it and acts with the return of each as its target.

    R="sb3-dtfm record --algo onnx --model go1_policy.onnx --env Go1Velocity-v0 --gym-packages go1.teachers --episodes 150"
    PYTHONPATH=studies $R --seed 11 --env-wrapper go1.teachers.Gentle --dataset-id go1/gentle-v0
    PYTHONPATH=studies $R --seed 12 --env-wrapper go1.teachers.Moderate --dataset-id go1/moderate-v0
    PYTHONPATH=studies $R --seed 13 --env-wrapper sb3_dtfm.envs.go1.env.TeacherObservation --dataset-id go1/fast-v0
    PYTHONPATH=studies python -m go1.qualities rows.jsonl --onnx go1_policy.onnx -n 3000 -params \\
        context_length:20 batch_size:64 learning_rate:0.002 \\
        "policy_kwargs:{'return_conditioning':True,'n_layers':2,'observation_scaling':'std'}"

A row has the share of the commanded velocity that the robot reaches, 1 if it walks as it is told.
"""

import argparse
from pathlib import Path

import minari
import numpy as np
import torch as th

from go1 import teachers
from go1.contexts import append, judge, missing, train
from sb3_dtfm.benchmark import provenance
from sb3_dtfm.cli.literals import key_value
from sb3_dtfm.envs import ReturnToGoWrapper
from sb3_dtfm.recording.onnx_agent import OnnxAgent

# Each dataset has a teacher of its own.
QUALITIES = {"gentle": teachers.Gentle, "moderate": teachers.Moderate, "fast": teachers.TeacherObservation}
DATASETS = [f"go1/{name}-v0" for name in QUALITIES]
SIMULATION = "ours"


def main() -> None:
    """See the top."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", type=Path, help="JSONL file to append to")
    parser.add_argument("--onnx", metavar="FILE", required=True, help="the teacher")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("-n", "--n-timesteps", type=int, default=3000, help="gradient steps")
    parser.add_argument("-params", nargs="+", type=key_value, metavar="KEY:VALUE", default=[], help="arguments of DTFM")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--models", type=Path, default=Path("logs/go1"), help="folder for the models")
    parser.set_defaults(datasets=DATASETS, hide_actions=None, target_return=None)
    options = parser.parse_args()

    def is_missing(cell: dict) -> bool:
        return bool(missing(options.rows, cell, {SIMULATION: {}}, {SIMULATION: options.episodes}))

    told = {"commit": provenance.commit(), "hardware": provenance.hardware(th.device("cpu"))}
    for name, wrapper in QUALITIES.items():
        cell = {"algo": "teacher", "label": name, "context_length": 1, "seed": 0}
        if is_missing(cell):
            found = judge(OnnxAgent(options.onnx), {}, [wrapper], options.episodes)
            append(options.rows, {**cell, "simulation": SIMULATION, **found, **told})
    for seed in options.seeds:
        context_length = dict(options.params).get("context_length", 1)
        cell = {"algo": "dtfm", "label": "three qualities", "context_length": context_length, "seed": seed}
        for name, dataset in zip(QUALITIES, DATASETS, strict=True):
            asked = {**cell, "label": f"asked for {name}"}
            if is_missing(asked):
                model, trained = train(cell, options)
                target_return = round(float(np.mean([episode.rewards.sum() for episode in minari.load_dataset(dataset)])), 3)
                wrapper = {f"{ReturnToGoWrapper.__module__}.ReturnToGoWrapper": {"target_return": target_return}}
                found = judge(model, {}, [wrapper], options.episodes)
                row = {**asked, "simulation": SIMULATION, **found, **trained, "target_return": target_return}
                append(options.rows, row)


if __name__ == "__main__":
    main()
