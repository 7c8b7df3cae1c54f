"""Pictures a second and bytes of replays, in headless Chromium without a graphics card, at 1280 × 720.

A row a flight: the size of its page, seconds until it is drawn, draw calls and triangles of a picture, pictures a
second while it plays, and the milliseconds that one picture takes when nothing else runs in the browser. Seconds depend
on the machine and on what else it does.

    python benchmarks/replay.py --json replay.json
    python benchmarks/replay.py out/case1/case1.parquet --envelopes both
"""

import argparse
import json
import os
import shutil
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, sync_playwright

from keepout.core.mission.build import fly
from keepout.core.mission.scenario import Scenario
from keepout.verbs.files import replay as replay_to_page

SOFTWARE = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
ISS = {
    "duration": 4000.0,
    "target": {"source": "iss"},
    "start": {"position": (40.0, 25.0, 30.0)},
    "goal": {"position": (0.0, -10.0, -6.0)},
}
PICTURE = """() => {
  const replay = keepoutReplay, gl = replay.renderer.getContext(), pixel = new Uint8Array(4), took = [];
  replay.fine(false);
  for (let k = 0; k < 20; k++) {
    const begin = performance.now();
    replay.transport.seek(replay.transport.end * k / 20);
    replay.render();
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel); // waits until it is drawn
    took.push(performance.now() - begin);
  }
  return took.sort((a, b) => a - b)[10];
}"""


def measured(browser: Browser, path: Path, seconds: float, *, guard: bool) -> dict[str, Any]:
    """Open one page, play it, and count."""
    page = browser.new_page(viewport={"width": 1280, "height": 720})
    begin = time.perf_counter()
    page.goto(path.absolute().as_uri())
    page.wait_for_selector("#replay[data-ready]", timeout=120_000)
    opened = time.perf_counter() - begin
    if guard:
        page.keyboard.press("g")
    picture = page.evaluate(PICTURE)
    # At the speed at which the flight lasts longest, so that it is still flying at the end.
    page.evaluate("() => { const of = keepoutReplay.transport; of.seek(0); of.faster(10); of.toggle(); }")
    counts = []
    for _ in range(3):
        begin, first = page.evaluate("[performance.now(), keepoutReplay.frames]")
        page.wait_for_timeout(1000.0 * seconds / 3.0)
        end, last = page.evaluate("[performance.now(), keepoutReplay.frames]")
        counts.append(1000.0 * (last - first) / (end - begin))
    state = page.evaluate("keepoutReplay.state()")
    page.close()
    return {
        "page": path.name,
        "megabytes": path.stat().st_size / 1e6,
        "opened_s": opened,
        "software": state["software"],
        "calls": state["calls"],
        "triangles": state["triangles"],
        "surfaces": sum(state["surfaces"]),
        "pictures_a_second": statistics.median(counts),
        "picture_ms": picture,
    }


def main() -> None:
    """Fly what is not given, write its page, and measure it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("flights", nargs="*", type=Path, help="flight files; by default two flights are flown")
    parser.add_argument("--seconds", type=float, default=6.0, help="to play")
    parser.add_argument("--envelopes", choices=("one", "both"), default="one", help="both: the guard's level too")
    parser.add_argument("--json", type=Path, help="also write the rows here")
    parser.add_argument("--keep", type=Path, help="folder to keep pages and flights in")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        flights = list(given.flights)
        for name, entries in () if flights else (("intelsat30", {}), ("iss", ISS)):
            path = folder / f"{name}.parquet"
            if not path.exists():
                fly(Scenario().replace(name=name, **entries)).record.save(path)
            flights.append(path)
        pages = [folder / f"{path.stem}.html" for path in flights]
        for path, page in zip(flights, pages):
            replay_to_page([path], page)
        chromium = os.environ.get("KEEPOUT_CHROMIUM") or shutil.which("chromium")
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=chromium, args=SOFTWARE)
            rows = [measured(browser, page, given.seconds, guard=given.envelopes == "both") for page in pages]
            told = {"browser": browser.version, "cores": len(os.sched_getaffinity(0)), "load": os.getloadavg()[0]}
            browser.close()
    for row in rows:
        print(
            "  ".join(
                f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}" for name, value in row.items()
            )
        )
    print(told)
    if given.json:
        given.json.write_text(json.dumps({**told, "rows": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
