"""Pages of the reports in a browser: opened, drawn, silent."""

from __future__ import annotations

import base64
import gzip
import json
import time
from pathlib import Path
from typing import Any


def charts_of(text: str) -> list[dict[str, Any]]:
    packed = text.split('id="packed-charts">')[1].split("<")[0]
    charts: list[dict[str, Any]] = json.loads(gzip.decompress(base64.b64decode(packed)))
    return charts


def open_page(browser: Any, path: Path, width: int, scheme: str = "light") -> None:
    metrics_of_screen = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 760}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics_of_screen)
    browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": width < 760})
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [{"name": "prefers-color-scheme", "value": scheme}]})
    browser.get(path.as_uri())
    deadline = time.monotonic() + 200
    while browser.execute_script("return document.documentElement.dataset.ready") != "1":
        assert time.monotonic() < deadline, browser.get_log("browser")
        time.sleep(0.05)


def assert_quiet_and_drawn(browser: Any, n_charts: int) -> None:
    assert browser.get_log("browser") == []
    assert browser.execute_script("return performance.getEntriesByType('resource').length") == 0
    drawn = browser.execute_script(
        "return [...document.querySelectorAll('.plot')].map(d => (d.data || []).map(t => (t.x || t.r || []).length))"
    )
    assert len(drawn) == n_charts
    empty = [i for i, lengths in enumerate(drawn) if not lengths or not all(lengths)]
    assert empty == []
