"""The random state of the process, which belongs to the caller, and repeatable gradients."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch


@contextmanager
def callers_random_state() -> Iterator[None]:
    """Python's, NumPy's and torch's random state is afterwards as it was before; also a decorator.

    Training seeds torch and draws from it. CUDA is not initialised for this: where the block
    initialises it, its generators are afterwards as torch starts them.
    """
    python, legacy, cpu, seed = (
        random.getstate(), np.random.get_state(), torch.get_rng_state(), torch.initial_seed()
    )  # fmt: skip
    cuda = torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else None
    try:
        yield
    finally:
        random.setstate(python)
        np.random.set_state(legacy)
        torch.set_rng_state(cpu)
        if cuda is not None:
            torch.cuda.set_rng_state_all(cuda)
        else:
            torch.cuda.manual_seed_all(seed)  # waits until CUDA is initialised, if it is not yet


@contextmanager
def repeatable_convolutions() -> Iterator[None]:
    """cuDNN takes kernels whose gradients are the same bits every time; also a decorator.

    It decides when a gradient is computed, so the block must contain that.
    """
    before = torch.backends.cudnn.deterministic
    torch.backends.cudnn.deterministic = True
    try:
        yield
    finally:
        torch.backends.cudnn.deterministic = before
