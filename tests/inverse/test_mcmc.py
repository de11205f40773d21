"""Chains on densities whose moments are known."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from splatsoil.inverse.mcmc import STRIDE, sample

from splatsoil.errors import RunError

COVARIANCE = np.array([[0.04, 0.03], [0.03, 0.04]])
LOW, HIGH = [-1.0, -1.0], [1.0, 1.0]


def bell(points: np.ndarray) -> np.ndarray:
    inside = np.all(np.abs(points) < 1.0, axis=1)
    square = np.einsum("ki,ij,kj->k", points, np.linalg.inv(COVARIANCE), points)
    return np.where(inside, -0.5 * square, -np.inf)


def test_a_bell_resumed_after_an_interruption_is_the_bell(tmp_path: Path) -> None:
    whole = sample(bell, LOW, HIGH, seed=1)
    assert whole.converged and np.all(whole.r_hat < 1.01)
    np.testing.assert_allclose(np.cov(whole.flat.T), COVARIANCE, rtol=0.15)
    np.testing.assert_allclose(whole.flat.mean(axis=0), 0.0, atol=0.02)
    assert 0.2 < whole.acceptance < 0.8
    file = tmp_path / "chains.h5"
    part = sample(bell, LOW, HIGH, seed=1, most_steps=STRIDE, file=file, identity="bell")
    assert part.steps == STRIDE < whole.steps
    resumed = sample(bell, LOW, HIGH, seed=1, file=file, identity="bell")
    assert np.array_equal(resumed.samples, whole.samples)
    # A file that has it all already gives the same, and is not made longer.
    again = sample(bell, LOW, HIGH, seed=1, file=file, identity="bell")
    assert np.array_equal(again.samples, whole.samples) and again.steps == whole.steps


def test_chains_of_another_density_are_thrown_away(tmp_path: Path) -> None:
    file = tmp_path / "chains.h5"
    sample(bell, LOW, HIGH, most_steps=STRIDE, file=file, identity="one", ensembles=2)
    file.write_bytes(file.read_bytes()[:2000])  # and one that was cut off by a kill can't be opened
    new = sample(lambda p: bell(p + 0.3), LOW, HIGH, most_steps=STRIDE, file=file, identity="other", ensembles=2)
    assert new.flat.mean() == pytest.approx(-0.3, abs=0.08)


def test_a_full_disk_is_said_before_anything_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "chains.h5"
    room = iter([10**9, 10**5])

    def usage(_: object) -> tuple[int, int, int]:
        return shutil._ntuple_diskusage(10**12, 0, next(room))  # type: ignore[attr-defined]

    monkeypatch.setattr("splatsoil.inverse.mcmc.shutil.disk_usage", usage)
    with pytest.raises(RunError, match=r"chains\.h5: 0\.1 MB are left .* free some space"):
        sample(lambda p: -0.5 * np.sum(p**2, axis=1), [-5.0], [5.0], file=file, identity="a")


def test_ensembles_that_disagree_are_not_called_converged() -> None:
    def two_peaks(points: np.ndarray) -> np.ndarray:
        """So far apart that no walker crosses, of equal height."""
        x = np.abs(points[:, 0])
        return np.where(x < 1.0, -0.5 * ((x - 0.9) / 0.002) ** 2, -np.inf)

    found = sample(two_peaks, [-1.0], [1.0], most_steps=400, walkers=4, ensembles=3)
    assert not found.converged


def test_flat_density_fills_the_box() -> None:
    found = sample(lambda p: np.where(np.abs(p[:, 0]) < 1.0, 0.0, -np.inf), [-1.0], [1.0], ensembles=2)
    assert found.flat.std() == pytest.approx(1.0 / np.sqrt(3.0), rel=0.05)


def test_nothing_to_sample(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="zero everywhere"):
        sample(lambda p: np.full(len(p), -np.inf), [-1.0], [1.0])
    (tmp_path / "file").touch()
    with pytest.raises(RunError, match="cannot be written"):
        sample(bell, LOW, HIGH, file=tmp_path / "file" / "chains.h5")


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("beyond", [-2.0, 0.3])
def test_a_density_that_is_no_number_somewhere_is_said_to_be_none_there(value: float, beyond: float) -> None:
    """At the starts, and where walkers come later."""

    def broken(points: np.ndarray) -> np.ndarray:
        return np.where(points[:, 0] > beyond, value, bell(points))

    with pytest.raises(RunError, match=rf"is {value} at \(-?\d.*finite or −∞"):
        sample(broken, LOW, [0.0, 1.0] if beyond == 0.3 else HIGH)
