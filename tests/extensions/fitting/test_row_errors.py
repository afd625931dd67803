"""Errors of learned rows by the command: recovered from states that have known ones."""

from __future__ import annotations

import json

import numpy as np
import pytest

from softgym_envs.extensions.fitting.row_errors import KNOTS, RowErrors


def test_mean_and_deviation_are_found():
    rng = np.random.default_rng(0)
    share = rng.random(4000)
    mean = np.stack([2.0 - 3.0 * share, np.zeros_like(share)], axis=1)
    deviation = np.stack([0.5 + share, np.full_like(share, 2.0)], axis=1)
    found = RowErrors.fit(share, mean + deviation * rng.standard_normal(mean.shape))
    for at in (0.15, 0.5, 0.85):
        expected, spread = found.at(at)
        np.testing.assert_allclose(expected, [2.0 - 3.0 * at, 0.0], rtol=0, atol=0.25)
        np.testing.assert_allclose(spread, [0.5 + at, 2.0], rtol=0.2)


def test_errors_that_are_a_line_have_no_deviation():
    share = np.linspace(0.0, 1.0, 20)
    found = RowErrors.fit(share, (1.0 + share)[:, None])
    assert found.deviation.max() < 1e-12
    assert found.at(0.4)[0] == pytest.approx([1.4])
    assert found.at(7.0)[0] == pytest.approx([2.0])  # beyond the range as at its end


def test_a_card_keeps_them():
    found = RowErrors.fit(np.linspace(0.0, 1.0, 20), np.random.default_rng(1).standard_normal((20, 3)))
    again = RowErrors.from_card(json.loads(json.dumps(found.to_card())))
    np.testing.assert_array_equal(again.mean, found.mean)
    np.testing.assert_array_equal(again.rows(np.array([2])).deviation, found.deviation[:, [2]])


@pytest.mark.parametrize("share", [np.linspace(0.0, 0.3, 20), np.linspace(0.0, 1.0, 2 * KNOTS - 1)])
def test_too_few_states_are_refused(share):
    with pytest.raises(ValueError, match="use more"):
        RowErrors.fit(share, np.zeros((len(share), 1)))
