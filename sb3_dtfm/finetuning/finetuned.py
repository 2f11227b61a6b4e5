"""A DTFM and the noise policy or residual policy that was learned for it, as one model."""

import io
from typing import Any, ClassVar, NoReturn

import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import GymEnv
from torch import nn

from sb3_dtfm.algorithms.model import KNOWN, POLICY_NAMES, SequenceModel
from sb3_dtfm.algorithms.options import TrainingOptions
from sb3_dtfm.finetuning.frozen_env import FrozenPolicyVecEnv
from sb3_dtfm.finetuning.online_actor import (
    ACTIVATIONS,
    OnlineActor,
    check_noise_actions,
    check_residual_actions,
    make_online_actor,
)
from sb3_dtfm.finetuning.residual_env import ResidualActionVecEnv
from sb3_dtfm.policies import DTFMPolicy, SequencePolicy

# Name of fine-tuned models in commands and folders of runs.
FINETUNED = "finetuned"
# Classes whose actors can be taken over, by whether they squash their actions by tanh; sb3-contrib is an extra.
SQUASHED = {"SAC": True, "TQC": True, "PPO": False, "A2C": False, "TRPO": False}


class FinetunedPolicy(DTFMPolicy):
    """DTFM's policy with a network that chooses its noise, or adds a residual action."""

    def set_online_actor(self, settings: dict[str, Any] | None) -> None:
        """
        Let an online actor choose from now on; its weights are for the caller to load.

        :param settings: settings of :class:`~sb3_dtfm.finetuning.online_actor.OnlineActor`; None draws noise again
        :raises ValueError: the head starts from no noise, or a setting out of range
        """
        if settings is None:
            self.online_actor = None
            return
        sizes = (self.observation_dim, self.options.embed_dim, check_noise_actions(self), self.action_dim)
        self.online_actor = make_online_actor(*sizes, settings).to(self.device).requires_grad_(False)

    def set_acting(self, **settings: Any) -> None:
        if isinstance(self.online_actor, OnlineActor) and self.online_actor.residual and "n_action_steps" in settings:
            check_residual_actions(self, self.options.changed(n_action_steps=settings["n_action_steps"]).n_action_steps)
        super().set_acting(**settings)

    def save(self, path: str) -> None:
        """
        Save the policy alone, as SB3 does.

        :param path: file to write
        :raises ValueError: it is fine-tuned, which only the model's own file can hold
        """
        if self.online_actor is not None:
            raise ValueError("A fine-tuned policy is saved with its model: model.save(path).")
        super().save(path)


class FinetunedDTFM(SequenceModel):
    """
    A DTFM with a noise policy (noise-space RL) or a residual policy (residual RL) that an online algorithm has learned.
    It acts, is saved, loaded and exported as a DTFM is.

    With `deterministic=True` a noise policy's actor maps rows of the model's noise table to noise, which is one draw of the
    actor's distribution that repeats exactly: at first this is what DTFM itself does, and it stays what the algorithm
    learns from. The actor's mean would begin at zero noise, where robot arms get stuck. A residual action is the
    actor's mean, whatever `deterministic` is: at first nearly none.

    Without an online actor it acts as the DTFM does. It does not learn from data; another actor is learned by
    `SAC("MlpPolicy", NoiseActionVecEnv(venv, model))` or `PPO("MlpPolicy", ResidualActionVecEnv(venv, model))`.

    `FinetunedDTFM.of` and `FinetunedDTFM.load` make one.
    """

    policy: FinetunedPolicy
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = dict.fromkeys(POLICY_NAMES, FinetunedPolicy)

    def __init__(
        self,
        policy: str | type[SequencePolicy] = POLICY_NAMES[0],
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = False,
    ) -> None:
        self.online_actor: dict[str, Any] | None = None
        super().__init__(policy, env, TrainingOptions(), 0.0, None, None, 0, None, device)

    def _make_policy(self, ema: bool) -> SequencePolicy:
        policy = super()._make_policy(ema)
        assert isinstance(policy, FinetunedPolicy)
        policy.set_online_actor(self.online_actor)
        return policy

    @classmethod
    def of(cls, model: SequenceModel, agent: BaseAlgorithm | None = None) -> "FinetunedDTFM":
        """
        A copy of a model, with an agent's actor.

        :param model: model to copy, which stays as it is
        :param agent: agent whose actor is taken, see :meth:`take_actor`; None for no actor
        :raises ValueError: an actor that cannot be taken over
        """
        file = io.BytesIO()
        model.save(file, exclude=set(vars(model)) - KNOWN)  # without a subclass's own attributes
        finetuned = cls.load(file, device=model.device)
        finetuned.policy.optimizer.state.clear()  # it learns no more: half of the file
        if agent is not None:
            finetuned.take_actor(agent)
        return finetuned

    def take_actor(self, agent: BaseAlgorithm) -> None:
        """
        Act by an agent's actor as it is now.

        :param agent: SAC, TQC, PPO, A2C or TRPO, whose "MlpPolicy" learns in a
            :class:`~sb3_dtfm.finetuning.NoiseActionVecEnv` or a :class:`~sb3_dtfm.finetuning.ResidualActionVecEnv`
        :raises ValueError: another kind of actor, or residual actions where several actions of a chunk are executed
        """
        settings, weights = _take_over(agent)
        if settings["residual"]:
            check_residual_actions(self.policy, self.policy.options.n_action_steps)
        if settings != self.online_actor or self.policy.online_actor is None:
            self.policy.set_online_actor(settings)
            self.online_actor = settings
        assert self.policy.online_actor is not None
        self.policy.online_actor.load_state_dict(weights)

    def learn(self, *args: Any, **kwargs: Any) -> NoReturn:
        """:raises ValueError: always"""
        raise ValueError(
            "A fine-tuned model does not learn from data: its online actor was learned for the weights that it has."
        )


def _take_over(agent: BaseAlgorithm) -> tuple[dict[str, Any], dict[str, th.Tensor]]:
    """
    An actor as settings and weights of :class:`~sb3_dtfm.finetuning.online_actor.OnlineActor`.

    :raises ValueError: an actor of another form
    """
    name = next((each.__name__ for each in type(agent).__mro__ if each.__name__ in SQUASHED), None)
    if name is None:
        _refuse(agent, f"it is a {type(agent).__name__}")
    env = _frozen_env(agent)
    policy: Any = agent.policy
    extractor = policy.actor.features_extractor if SQUASHED[name] else policy.pi_features_extractor
    if type(extractor) is not FlattenExtractor:
        _refuse(agent, f"it sees features of a {type(extractor).__name__}")
    if getattr(agent, "use_sde", False):
        _refuse(agent, "its exploration depends on the state (use_sde)")
    latent, mean, log_std = (
        (policy.actor.latent_pi, policy.actor.mu, policy.actor.log_std)
        if SQUASHED[name]
        else (policy.mlp_extractor.policy_net, policy.action_net, policy.log_std)
    )
    if not SQUASHED[name] and policy.squash_output:
        _refuse(agent, "squash_output=True")
    linear, activations = latent[::2], {type(each).__name__ for each in latent[1::2]} or {"ReLU"}
    plain = isinstance(agent.observation_space, spaces.Box) and all(isinstance(each, nn.Linear) for each in linear)
    if not plain or len(activations) != 1 or not activations <= set(ACTIVATIONS):
        _refuse(agent, f"its actor is {latent}, expected linear layers with one of {', '.join(ACTIVATIONS)} between them")
    settings = {
        "layers": [each.out_features for each in linear],
        "activation": activations.pop(),
        "squashed": SQUASHED[name],
        "bound": env.bound,
        "hidden_state": env.hidden_state,
        "residual": isinstance(env, ResidualActionVecEnv),
    }
    weights = {f"layers.{i}.0.{key}": value for i, each in enumerate(linear) for key, value in each.state_dict().items()}
    weights |= {f"mean.{key}": value for key, value in mean.state_dict().items()}
    if isinstance(log_std, nn.Linear):
        weights |= {f"log_std.{key}": value for key, value in log_std.state_dict().items()}
    else:  # the same for all observations
        weights |= {"log_std.weight": th.zeros_like(mean.weight), "log_std.bias": log_std.detach()}
    return settings, weights


def _frozen_env(agent: BaseAlgorithm) -> FrozenPolicyVecEnv:
    """
    The environment that an agent learns in, whose observations it sees as they are.

    :raises ValueError: another environment, or something between
    """
    env: Any = agent.get_env()
    while env is not None and not isinstance(env, FrozenPolicyVecEnv):
        if getattr(env, "norm_obs", False):
            _refuse(agent, "VecNormalize stands between its actor and observations that are normalised already")
        env = getattr(env, "venv", None)
    if env is None:
        _refuse(agent, "it does not learn in a NoiseActionVecEnv or ResidualActionVecEnv")
    if agent.observation_space.shape != env.observation_space.shape:
        found = f"{agent.observation_space.shape}, and the {type(env).__name__} shows {env.observation_space.shape}"
        _refuse(agent, f"it sees observations of {found}")
    return env


def _refuse(agent: BaseAlgorithm, why: str) -> NoReturn:
    raise ValueError(
        f'The actor of {type(agent).__name__} cannot be taken over: {why}. The "MlpPolicy" of {", ".join(SQUASHED)} can.'
    )
