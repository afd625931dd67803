"""Interrupted trainings."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest


@contextmanager
def interrupted_at(learner: type, step: int) -> Iterator[None]:
    """Interrupt the training inside, as Ctrl-C does, when a learner goes on after so many steps."""
    original = learner.learn

    def learn(self, target, progress):
        if self.step >= step:
            raise KeyboardInterrupt
        original(self, target, progress)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(learner, "learn", learn)
        yield
