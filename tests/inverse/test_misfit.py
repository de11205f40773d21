"""The misfit's size and structure, on fields drawn from a known covariance."""

from __future__ import annotations

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from splatsoil.inverse.misfit import measure

CAMERAS, FRAMES, NX, NY, CELL = 2, 8, 8, 6, 0.04
PLACES = [
    SimpleNamespace(camera=f"c{c}", frame=10 * f, x=CELL * i, y=CELL * j)
    for c, f, j, i in product(range(CAMERAS), range(FRAMES), range(NY), range(NX))
]
TIME, LENGTH, BETWEEN, STD = 0.7, 0.06, 0.5, 3.0


def correlation() -> np.ndarray:
    """Of all pairs of blocks, written down pair by pair."""
    camera = np.array([p.camera for p in PLACES])
    frame = np.array([p.frame for p in PLACES]) / 10
    place = np.array([(p.x, p.y) for p in PLACES])
    return (
        np.where(camera[:, None] == camera, 1.0, BETWEEN)
        * TIME ** np.abs(frame[:, None] - frame)
        * np.exp(-np.linalg.norm(place[:, None] - place, axis=-1) / LENGTH)
    )


BASIS = np.linalg.qr(np.random.default_rng(1).normal(size=(len(PLACES), 2)))[0]


def test_size_and_correlations_are_recovered() -> None:
    factor = np.linalg.cholesky(correlation() + 1e-9 * np.eye(len(PLACES)))
    rng = np.random.default_rng(2)
    found = [
        measure(STD * factor @ rng.standard_normal(len(PLACES)), np.full(len(PLACES), 0.01), BASIS, PLACES)
        for _ in range(12)
    ]
    assert all(m.present for m in found)
    assert np.mean([m.std for m in found]) == pytest.approx(STD, rel=0.15)
    assert np.mean([m.time for m in found]) == pytest.approx(TIME, abs=0.1)
    assert np.median([m.length for m in found]) == pytest.approx(LENGTH, rel=0.3)
    assert np.mean([m.cameras for m in found]) == pytest.approx(BETWEEN, abs=0.1)


def test_the_projected_covariance_is_the_dense_one() -> None:
    factor = np.linalg.cholesky(correlation() + 1e-9 * np.eye(len(PLACES)))
    field = STD * factor @ np.random.default_rng(3).standard_normal(len(PLACES))
    # A tenth of the blocks is hidden: the lattice has holes.
    seen = np.random.default_rng(4).random(len(PLACES)) < 0.9
    places = [p for p, s in zip(PLACES, seen, strict=True) if s]
    found = measure(field[seen], np.full(seen.sum(), 0.01), BASIS[seen], places)
    camera = np.array([p.camera for p in places])
    frame = np.array([p.frame for p in places]) / 10
    place = np.array([(p.x, p.y) for p in places])
    dense = (
        np.where(camera[:, None] == camera, 1.0, found.cameras)
        * found.time ** np.abs(frame[:, None] - frame)
        * np.exp(-np.linalg.norm(place[:, None] - place, axis=-1) / found.length)
    )
    np.testing.assert_allclose(found.covariance, found.std**2 * BASIS[seen].T @ dense @ BASIS[seen], rtol=1e-8)


def test_chance_alone_is_no_misfit() -> None:
    noise = np.random.default_rng(5).normal(0.0, 2.0, len(PLACES))
    found = measure(noise, np.full(len(PLACES), 4.0), BASIS, PLACES)
    assert not found.present and found.ratio == pytest.approx(1.0, abs=0.2)
    assert not found.covariance.any()


def test_smooth_misfit_counts_for_more_than_independent_misfit() -> None:
    """In a smooth direction; that is why the structure has to be known."""
    smooth = np.ones((len(PLACES), 1)) / len(PLACES) ** 0.5
    factor = np.linalg.cholesky(correlation() + 1e-9 * np.eye(len(PLACES)))
    field = STD * factor @ np.random.default_rng(6).standard_normal(len(PLACES))
    field -= smooth[:, 0] * (smooth[:, 0] @ field)
    known = np.full(len(PLACES), 0.01)
    structured, independent = (measure(field, known, smooth, where) for where in (PLACES, None))
    assert structured.covariance[0, 0] > 10.0 * independent.covariance[0, 0]


def test_the_misfit_counts_where_parameters_act() -> None:
    """Most blocks never change and err little; a tenth does, and errs ten times as much: what is carried into the
    basis is the dense covariance of that field, on the average."""
    rng = np.random.default_rng(8)
    active = np.arange(len(PLACES)) % 10 == 0
    std = np.where(active, STD, 0.1 * STD)
    basis = np.linalg.qr(rng.normal(size=(len(PLACES), 2)) * active[:, None])[0]
    found = [measure(std * rng.normal(size=len(PLACES)), np.full(len(PLACES), 1e-4), basis, PLACES) for _ in range(20)]
    dense = basis.T @ (std[:, None] ** 2 * basis)
    np.testing.assert_allclose(np.mean([f.covariance for f in found], axis=0), dense, rtol=0.25, atol=0.1 * STD**2)
