"""
Act with an exported policy: NumPy and ONNX Runtime alone.

`python examples/deploy.py policy.onnx` plays episodes of the task that the file names, robosuite's Lift for example. The
environment comes from this package; `Policy` needs nothing of it, and goes wherever ONNX Runtime does.
"""

import argparse
import ast
import json
import time
import zlib

import numpy as np
import onnxruntime

TYPES = {"tensor(float)": np.float32, "tensor(int64)": np.int64, "tensor(bool)": np.bool_, "tensor(uint8)": np.uint8}
KEPT = {"keys_values", "features"}  # what a call gives to the next one


class Policy:
    """
    The policy of one environment, with the context of its last steps.

    :param path: what `model.export` wrote
    """

    def __init__(self, path: str) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self.session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        self.settings = json.loads(self.session.get_modelmeta().custom_metadata_map["sb3_dtfm"])
        shapes = {each.name: ([1, *each.shape[1:]], TYPES[each.type]) for each in self.session.get_inputs()}
        self.inputs = {name: np.zeros(shape, dtype) for name, (shape, dtype) in shapes.items()}
        self.plan: list[np.ndarray] = []

    def act(
        self, observation: np.ndarray, return_to_go: float, timestep: int, images: dict[str, np.ndarray] | None = None
    ) -> np.ndarray | np.int64:
        """
        The next action, as `predict(deterministic=True)` chooses it; time step 0 begins an episode.

        :param observation: (O,)
        :param return_to_go: target return minus the rewards so far, at least target * (1 - t / T)
        :param timestep: counted from the episode's start
        :param images: by camera, uint8 of (height, width, channels), or channels first
        :return: (A,) in the environment's range, or a number where its action space is Discrete
        """
        for camera, shape in self.settings["images"].items():
            image = (images or {})[camera]
            first = image if list(image.shape) == shape else np.moveaxis(image, -1, 0)
            if image.dtype != np.uint8 or list(first.shape) != shape:
                found = f"{image.dtype} of {image.shape}"
                raise ValueError(f"{camera}: expected uint8 of {shape}, channels first or last; got {found}.")
            self.inputs[camera][0] = first
        if timestep == 0:
            self.inputs["mask"][:], self.plan = False, []
            if "episode_keys" in self.inputs:
                key = zlib.crc32(observation.astype(np.float32) + 0.0)  # no negative zeros
                for camera in self.settings["images"]:
                    key = zlib.crc32(self.inputs[camera], key)
                self.inputs["episode_keys"][:] = key
        newest = {"observations": observation, "returns_to_go": return_to_go, "timesteps": timestep, "mask": True}
        for name, value in {**newest, "actions": 0.0}.items():
            self.inputs[name] = np.roll(self.inputs[name], -1, axis=1)
            self.inputs[name][:, -1] = value
        if not self.plan or KEPT & set(self.inputs):  # what is kept grows with each step
            chunk, *kept = self.session.run(None, self.inputs)
            names = [each.name.removeprefix("next_") for each in self.session.get_outputs()[1:]]
            self.inputs.update(zip(names, kept, strict=True))
            self.plan = self.plan or list(chunk[0, : self.settings["n_action_steps"]])
        self.inputs["actions"][:, -1] = action = self.plan.pop(0)
        first = self.settings["first_action"]
        return action if first is None else first + action.argmax()


def main() -> None:
    parser = argparse.ArgumentParser(description="Play episodes with an exported policy.")
    parser.add_argument("policy", help="what `sb3-dtfm export` wrote")
    parser.add_argument("--env", help="Gymnasium id; what the file says by default")
    parser.add_argument("--env-kwargs", nargs="+", default=[], metavar="NAME:VALUE", help="such as cameras:['agentview']")
    parser.add_argument("--target-return", type=float, help="in reward units; by default the file's")
    parser.add_argument("--episodes", type=int, default=10, help="10 by default")
    parser.add_argument("--seed", type=int, default=0, help="of the first initial state")
    options = parser.parse_args()

    import gymnasium

    from sb3_dtfm.envs import ReturnToGoWrapper  # its import registers robosuite's tasks, too

    policy = Policy(options.policy)
    env_id = options.env or policy.settings["env_id"]
    target = policy.settings["target_return"] if options.target_return is None else options.target_return
    if env_id is None or target is None:
        parser.error("the file lacks a task or a target return: give --env and --target-return")
    given = (each.partition(":") for each in options.env_kwargs)
    env_kwargs = {name: ast.literal_eval(value) for name, _, value in given}
    # Makes vectors, and counts what is left of the return.
    env = ReturnToGoWrapper(gymnasium.make(env_id, **env_kwargs), target)
    for episode in range(options.episodes):
        observation, info = env.reset(seed=options.seed + episode)
        total, timestep, done, milliseconds = 0.0, 0, False, []
        while not done:
            start = time.perf_counter()
            images = {camera: observation[camera] for camera in policy.settings["images"]}
            action = policy.act(observation["observation"], observation["return_to_go"].item(), timestep, images)
            milliseconds.append((time.perf_counter() - start) * 1e3)
            observation, reward, terminated, truncated, info = env.step(action)
            total, timestep, done = total + float(reward), timestep + 1, terminated or truncated
        success = f", success {info['is_success']}" if "is_success" in info else ""
        took = f"{np.mean(milliseconds):.2f} ms an action"
        print(f"episode {episode}: {timestep} steps, return {total:g}{success}; {took}")


if __name__ == "__main__":
    main()
