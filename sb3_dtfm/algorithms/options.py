"""Options of training, which are arguments of the algorithm."""

from dataclasses import dataclass

from sb3_dtfm.arguments import (
    BOOLEAN,
    COUNT,
    NOT_NEGATIVE,
    PROBABILITY_BELOW_1,
    Choice,
    Number,
    Options,
    option,
)
from sb3_dtfm.optimization import LEARNING_RATE_SCHEDULES, PRECISIONS


@dataclass(frozen=True)
class TrainingOptions(Options):
    """
    Options of the windows that are drawn, and of the gradient steps that learn from them.

    :param batch_size: number of windows in a gradient step, of all processes together. It is 64 for fewer than 10,000
        recorded steps or with images, else 256
    :param context_length: number of steps that the policy observes, K
    :param return_weighting: weight w of good episodes: a step of the best one is drawn 1 + w times as often as one of the
        worst, others in between by their returns (Yue et al., 2022); 0 draws all alike. It is 5 where returns predict
        actions, else 0
    :param weight_decay: AdamW's weight decay, of weight matrices only
    :param learning_rate_schedule: schedule of the learning rate: "constant", or "linear" or "cosine" down to zero
    :param warmup_steps: number of gradient steps over which the learning rate rises linearly from zero
    :param max_grad_norm: largest norm of the gradient, to which larger ones are clipped; None and 0 do not clip
    :param ema_decay: decay of the moving average of the weights, which acts; 0 acts with the trained weights
    :param precision: precision of matrix products: "float32", "bfloat16" (autocast), or "auto": bfloat16 if the hardware
        has instructions for it, on a CPU only if it is faster for this model, which is measured once
    :param compile: whether the loss is compiled with `torch.compile`, which takes a minute and a C++ compiler; None
        compiles on a GPU, where one process starts its kernels as a CUDA graph
    :raises ValueError: an option out of range, by name
    """

    batch_size: int | None = option(None, COUNT._replace(optional=True))
    context_length: int = option(1, Number(low=1, high=100_000, whole=True))
    return_weighting: float | None = option(None, NOT_NEGATIVE._replace(optional=True))
    weight_decay: float = option(1e-3, NOT_NEGATIVE)
    learning_rate_schedule: str = option("cosine", Choice(LEARNING_RATE_SCHEDULES))
    warmup_steps: int = option(100, Number(low=0, whole=True))
    max_grad_norm: float | None = option(None, NOT_NEGATIVE._replace(optional=True))
    ema_decay: float = option(0.999, PROBABILITY_BELOW_1)
    precision: str = option("float32", Choice(PRECISIONS))
    compile: bool | None = option(None, Choice((None, *BOOLEAN.values)))
