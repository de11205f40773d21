from __future__ import annotations

import pytest

from splatsoil.commands._progress import stages


def test_a_log_gets_a_line_a_stage_and_a_line_a_tenth(capsys: pytest.CaptureFixture[str]) -> None:
    with stages() as begin:
        report = begin("fit")
        for share in (0.01, 0.05, 0.1, 0.15, 0.3, 0.35):
            report(f"at {share}", share)
        begin("report")
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.splitlines() == ["fit", "fit: 10 %, at 0.1", "fit: 30 %, at 0.3", "report"]


def test_quiet_is_quiet(capsys: pytest.CaptureFixture[str]) -> None:
    with stages(quiet=True) as begin:
        begin("fit")("something", 0.5)
    assert capsys.readouterr() == ("", "")


def test_a_terminal_gets_bars_with_the_time_left(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    with stages() as begin:
        report = begin("fit")
        report("[4] of 10", 0.4)
    err = capsys.readouterr().err
    assert "fit" in err and "100 %" in err and "left" in err
