"""Base of networks that predict the entries of W and delta_free, as the thesis' networks do."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from softgym_envs.extensions.fitting.data.states import full_compliance
from softgym_envs.surrogate.model import Context, SurrogateModel


class DirectModel(SurrogateModel):
    """A model that predicts `States.entries`. W is symmetric but not always positive definite."""

    @abstractmethod
    def _entries(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        """Return upper triangles of W, then delta_free, shape (B, k)."""

    def _outputs(self, context: Context, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        y = self._entries(context, displacement)
        entries = self.size * (self.size + 1) // 2
        return full_compliance(y[:, :entries], self.size), y[:, entries:]

    def _state(self, context: Context, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        W, free = self._outputs(context, displacement)
        a, e = slice(0, self.count), slice(self.count, self.size)
        effort = np.linalg.solve(W[:, a, a], (displacement - free[:, a])[:, :, None])
        return effort[:, :, 0], (W[:, e, a] @ effort)[:, :, 0] + free[:, e], np.full(len(effort), np.inf)

    def _compliance(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        return self._outputs(context, displacement)[0]
