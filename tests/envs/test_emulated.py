"""The emulated environments: response surfaces against closed forms, and against the simulator they stand for."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from splatsoil.envs import VARIANTS, emulator
from splatsoil.envs.emulated import EmulatedProblem
from splatsoil.envs.synthetic import SyntheticProblem
from splatsoil.envs.together import attempt

from splatsoil.errors import ParameterError


@pytest.mark.parametrize("name", VARIANTS)
def test_every_fast_id_is_a_clean_environment_with_its_seed_and_spec(name: str) -> None:
    env = gym.make(f"{name}Fast-v0")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    assert env.spec is not None
    twin = gym.make(EnvSpec.from_json(json.dumps(json.loads(env.spec.to_json()))))
    env.action_space.seed(0)
    action = env.action_space.sample()
    first, second = ((*e.reset(seed=5), *e.step(action)) for e in (env, twin))
    assert first[3] == second[3] and first[5] == second[5]
    assert gym.make(f"{name}-v0").action_space == env.action_space


def test_a_surface_is_the_polynomial_and_the_chance_that_made_its_data() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-1.0, 1.0, (400, 2))
    basis = np.linalg.qr(rng.normal(size=(6, 3)))[0]

    def truth(p: np.ndarray) -> np.ndarray:
        return np.stack([1.0 + p[:, 0], p[:, 0] * p[:, 1], 3.0 * p[:, 1] ** 2], axis=1)

    chance = rng.normal(size=(400, 6)) * np.array([0.1, 0.2, 0.3, 0.1, 0.1, 0.1])
    chance *= np.exp(0.5 * points[:, :1])
    surface = emulator.Surface.fit(points, truth(points) @ basis.T + chance, basis, basis)
    at = np.array([[0.3, -0.6], [0.0, 0.9]])
    assert surface.degree == 2
    np.testing.assert_allclose(surface.mean(at), truth(at), atol=0.1)
    np.testing.assert_allclose(surface.growth, [0.5, 0.0], atol=0.1)
    expected = basis.T @ np.diag([0.1, 0.2, 0.3, 0.1, 0.1, 0.1]) ** 2 @ basis
    np.testing.assert_allclose(surface.factor @ surface.factor.T, expected, atol=0.02)
    assert surface.left == pytest.approx(0.17 - np.trace(expected), rel=0.15)
    drawn = np.array([surface.draw(at[0], seed)[0] for seed in range(4000)])
    np.testing.assert_allclose(np.cov(drawn.T), np.exp(0.3) * expected, atol=0.02)


def test_leave_one_out_errors_are_those_of_fits_without_each() -> None:
    rng = np.random.default_rng(1)
    terms, scores = rng.normal(size=(12, 4)), rng.normal(size=(12, 2))
    for k, error in enumerate(emulator._left_out(terms, scores)):
        rest = np.arange(12) != k
        fitted = np.linalg.lstsq(terms[rest], scores[rest], rcond=None)[0]
        np.testing.assert_allclose(error, scores[k] - terms[k] @ fitted)


def test_surfaces_are_read_as_they_were_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shipped = dict(emulator.surfaces())
    emulator.save(tmp_path / "made.npz", shipped)
    monkeypatch.setattr(emulator, "FILE", tmp_path / "made.npz")
    again = emulator.surfaces.__wrapped__()
    assert set(again) == set(shipped) == {*emulator.GUESSED, *(f"stroke/{e}" for e in emulator.STRENGTHS)}
    assert all(np.array_equal(again[k].coefficients, shipped[k].coefficients) for k in shipped)
    assert emulator.main([]) == 2


@pytest.mark.slow
def test_the_file_is_made_by_its_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a few simulations; its pictures change with the friction angle as those of the shipped one do."""
    torch.set_num_threads(1)
    monkeypatch.setattr(emulator, "GUESSED", {"one": (("friction_angle",), (), 8)})
    monkeypatch.setattr(emulator, "STRENGTHS", {"none": None})
    monkeypatch.setattr(emulator, "STROKE_SIMULATIONS", 12)
    monkeypatch.setattr(emulator, "PATCH_COMPONENTS", 2)
    assert emulator.main([str(tmp_path / "made.npz")]) == 0
    shipped = emulator.surfaces()["one"]
    monkeypatch.setattr(emulator, "FILE", tmp_path / "made.npz")
    made = emulator.surfaces.__wrapped__()
    assert set(made) == {"one", "stroke/none"}
    points = np.linspace(-0.8, 0.8, 5)[:, None]
    ours, theirs = (s.mean(points) @ s.patches.T for s in (made["one"], shipped))
    assert np.corrcoef(ours.ravel(), theirs.ravel())[0, 1] > 0.9


def test_what_nothing_emulates_is_refused() -> None:
    with pytest.raises(ParameterError, match="only friction_angle with effects none"):
        gym.make("PlowSandFast-v0", parameters=["friction_angle", "cohesion"], effects=["cohesion"])
    with pytest.raises(ParameterError, match="no measurement"):
        gym.make("PlowSandFast-v0", measurement="examples/plow-dry")


@pytest.mark.slow
def test_emulated_losses_are_those_of_simulations() -> None:
    """Of truths and guesses that the surface was not made from."""
    torch.set_num_threads(1)
    simulated, emulated = SyntheticProblem(), EmulatedProblem()
    guesses, off = (23.0, 31.0, 38.0, 46.0), []
    for truth in (25.0, 32.0, 39.0):
        simulated.place({"friction_angle": truth}, 900)
        for k, guess in enumerate(guesses):
            real = attempt(simulated, {"friction_angle": guess}, k).loss
            drawn = []
            for seed in range(300):
                emulated.place({"friction_angle": truth}, seed)
                drawn.append(emulated.evaluate({"friction_angle": guess}, 1000 + seed).loss)
            if real is not None:  # a simulation may fail
                off.append((real - np.mean(drawn)) / np.std(drawn))  # type: ignore[arg-type]
    assert len(off) >= 8 and np.abs(off).max() < 4.0 and np.sqrt(np.mean(np.square(off))) < 2.0
