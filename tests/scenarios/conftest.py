"""Fixtures of several test files: a browser, and commands in this process."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from scenarios import cli, guard
from tests.scenarios.damage import Relnav, Run


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    chromedriver = shutil.which("chromedriver")
    if chromium is None or chromedriver is None:
        pytest.skip("chromium and chromedriver are not installed: the page is not seen by a browser")
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed: the page is not seen by a browser")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    flags = "headless=new no-sandbox disable-gpu no-first-run disable-background-networking disable-component-update disable-sync"
    for flag in (*flags.split(), "window-size=1280,900", f"user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(f"--{flag}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(chromedriver))
    yield driver
    driver.quit()


@pytest.fixture
def relnav(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Relnav:
    """Runs a command in this process; smoothing without report, into the folder `out` beside the flight."""
    monkeypatch.setattr(guard, "Trace", lambda path: None)
    monkeypatch.setattr(guard, "run", lambda argv, out, quiet=False: cli.main([*argv, guard.TRACE_OPTION, "unused"]))

    def run(command: str, *argv: object) -> Run:
        out = Path(str(argv[0])).parent / "out"
        more = ["--no-report", "--out", str(out)] if command == "smooth" else []
        code = cli.main([command, *map(str, argv), *more])
        printed, err = capsys.readouterr()
        return Run(code, err.splitlines(), printed, out)

    return run


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    """A flight folder with one vehicle and twenty position fixes."""
    folder = tmp_path / "walk"
    folder.mkdir()
    rows = [f"{t},{1.5 * t},{0.1 * t * t},2.0" for t in range(20)]
    (folder / "fixes.csv").write_text("t,x,y,z\n" + "\n".join(rows) + "\n", encoding="utf-8")
    (folder / "flight.toml").write_text(
        '[flight]\nname = "walk"\nt0 = "2021-09-22T06:30:00"\norigin = { lat_deg = 35.0, lon_deg = 139.0 }\n'
        '[[vehicle]]\nname = "walker"\n[[vehicle.positions]]\nfile = "fixes.csv"\n',
        encoding="utf-8",
    )
    return folder
