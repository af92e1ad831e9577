"""Pictures of the four kinds of report in a browser, for the docs.

    python benchmarks/report_screenshots.py [FOLDER]

Simulates the logs, makes the reports, and writes a picture of each kind (report-smooth.webp,
report-changes.webp, report-compare.webp, report-experiment.webp): 1280 and 390 pixels wide, in
light and in dark, side by side. FOLDER is docs/figures unless given. Needs Chromium from the
system's packages and `pip install .[browser]`; takes about a minute.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
from playwright.sync_api import Browser, sync_playwright

ROOT = Path(__file__).parent.parent
WIDTHS, THEMES, HEIGHT = (1280, 390), ("light", "dark"), 900
SCALE, QUALITY, GAP = 0.5, 70, 12  # of the pictures; GAP in pixels of the page
#: where the sliders of the first figure stand
SLIDERS = {"smooth": {"swipe": "38", "time": "720"}, "changes": {"swipe": "45"}}


def reports(folder: Path) -> dict[str, Path]:
    """Kind -> report.html."""

    def run(*arguments: object) -> None:
        command = [sys.executable, "-m", "graphslam", *map(str, arguments), "--quiet"]
        subprocess.run(command, check=True, cwd=ROOT)

    run("simulate", "lab", "-o", folder / "lab.mcap")
    run("smooth", folder / "lab.mcap", "-o", folder / "smooth", "--start", "truth")
    run("simulate", "change", "-o", folder / "visits")
    for visit in ("reference", "later"):
        run("smooth", folder / "visits" / f"{visit}.mcap", "-o", folder / visit)
    run("changes", folder / "reference", folder / "later", "-o", folder / "changes")
    run("compare", folder / "lab.mcap", "--start", "truth", "-o", folder / "compare")
    run("experiment", "ekf-versus-smoothing", "--runs", 5, "-o", folder / "experiment")
    kinds = ("smooth", "changes", "compare", "experiment")
    return {kind: folder / kind / "report.html" for kind in kinds}


def picture(browser: Browser, kind: str, report: Path) -> np.ndarray:
    """All widths and themes of one report side by side, from its first moving figure on."""
    shots = []
    for width in WIDTHS:
        for theme in THEMES:
            context = browser.new_context(
                viewport={"width": width, "height": HEIGHT}, color_scheme=theme
            )
            page = context.new_page()
            page.goto(report.as_uri())
            page.evaluate("document.querySelector('.live').scrollIntoView()")
            page.wait_for_selector(".live[data-ready]")
            for name, value in SLIDERS.get(kind, {}).items():
                page.locator(f".live input[name={name}]").first.fill(value)
            page.wait_for_timeout(500)
            shot = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
            shots.append(
                cv2.copyMakeBorder(shot, 0, 0, 0, GAP, cv2.BORDER_CONSTANT, value=[128] * 3)
            )
            context.close()
    return cv2.resize(np.hstack(shots), None, fx=SCALE, fy=SCALE, interpolation=cv2.INTER_AREA)


def main() -> None:
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs" / "figures"
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        sys.exit("needs Chromium from the system's packages: apt-get install chromium")
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        for kind, report in reports(Path(folder)).items():
            file = target / f"report-{kind}.webp"
            cv2.imwrite(
                str(file), picture(browser, kind, report), [cv2.IMWRITE_WEBP_QUALITY, QUALITY]
            )
            print(f"{file}: {file.stat().st_size / 1e3:.0f} kB")
        browser.close()


if __name__ == "__main__":
    main()
