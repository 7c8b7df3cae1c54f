"""Build the documentation site into out/site, strictly: any warning is an error.

python docs/site.py             # build
python docs/site.py --serve     # build and show it at http://localhost:8000, again after each change
"""

import re
import subprocess
import sys
from pathlib import Path

DOCS = Path(__file__).parent
CONFIGURATION = DOCS.parent / "zensical.toml"  # written here, as Zensical looks for pages below its configuration only
SITE = DOCS.parent / "out" / "site"
PAGE_IN_NAV = re.compile(r'"([^"]+\.md)"')
SHIM, OUR_SHIM = "https://unpkg.com/iframe-worker/shim", "assets/iframe-worker/shim.js"
"""Lets the page of a local file search (npm's iframe-worker 1.0.4): where Zensical has it from, and its place here."""


def completed(configuration: str) -> str:
    """Give the configuration with a nav of the pages that exist: each page once, none left out."""
    head, rest = configuration.split("nav = [\n", 1)
    nav, tail = rest.split("\n]\n", 1)
    existing = {page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*.md")} - {"assets/katex/README.md"}
    left = existing - set(PAGE_IN_NAV.findall(nav))
    lines: list[str] = []
    for line in nav.splitlines():
        named = PAGE_IN_NAV.search(line)
        if named and "*" in named[1]:
            folder = Path(named[1]).parent
            matched = sorted(page for page in left if Path(page).parent == folder)
            left.difference_update(matched)
            lines += [f'        "{page}",' for page in matched]
        elif named is None or named[1] in existing:
            lines.append(line)
    if left:
        raise SystemExit(f"docs/site.toml: no line of the nav matches {', '.join(sorted(left))}")
    return head + "nav = [\n" + "\n".join(lines) + "\n]\n" + tail


def build(*, serve: bool = False) -> int:
    """Write the completed configuration and run Zensical on it."""
    CONFIGURATION.write_text(completed((DOCS / "site.toml").read_text(encoding="utf-8")), encoding="utf-8")
    words = ["serve"] if serve else ["build", "--strict", "--clean"]
    code = subprocess.run([sys.executable, "-m", "zensical", *words, "--config-file", str(CONFIGURATION)]).returncode
    if code == 0 and not serve:
        for page in SITE.rglob("*.html"):
            to_root = "../" * len(page.relative_to(SITE).parts[1:])
            text = page.read_text(encoding="utf-8")
            page.write_text(text.replace(SHIM, to_root + OUR_SHIM), encoding="utf-8")
    return code


if __name__ == "__main__":
    sys.exit(build(serve="--serve" in sys.argv))
