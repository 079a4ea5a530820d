"""The screenshots of the README: the live page, fed from recordings, and the page of a diagnosis; after a `make demo`.

    python -m tests.bench.screens [demo-out] [folder]

Chromium shows the pages as anybody sees them; the pictures are reduced to few colours, so that they stay small.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

from compensator.clock import NS
from compensator.recording.reading import read_messages, recordings
from compensator.watch.server import PageServer
from compensator.watch.shop import Shop
from tests.watch.heard import Clock, status

TOP = Path(__file__).resolve().parents[2]
MACHINE = "vmc-07"
#: Largest picture, bytes; colours of its palette.
LARGEST, COLOURS = 100_000, 48


def photograph(address: str, out: Path, width: int, height: int, scale: float = 1.5) -> None:
    """Save what a browser shows of an address."""
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        sys.exit("screens: chromium is not installed")
    with tempfile.TemporaryDirectory() as folder:
        shown = Path(folder) / "shown.png"
        options = ("--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--virtual-time-budget=4000")
        options += (f"--force-device-scale-factor={scale}", "--blink-settings=preferredColorScheme=1")
        command = [browser, *options, f"--user-data-dir={folder}/profile", f"--window-size={width},{height}"]
        subprocess.run([*command, f"--screenshot={shown}", address], check=True, capture_output=True, timeout=100)
        with Image.open(shown) as image:
            image.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(out, optimize=True)
    size = out.stat().st_size
    print(f"{out}: {size / 1000:.0f} kB")
    if size > LARGEST:
        sys.exit(f"{out}: larger than {LARGEST / 1000:.0f} kB")


def filled(folder: Path, hours: float) -> Shop:
    """Return a shop with one machine, as watch has it some hours after the start of a day's recordings."""
    clock = Clock()
    shop = Shop(clock)
    shop.set_alive(f"shop/{MACHINE}/thermal/alive", True)
    begin = None
    for path in recordings(folder, "sim-conduction"):
        for record in read_messages(path, ("sample", "estimate", "offset", "event")):
            if begin is None:
                begin = record.log_time_ns
                about = status(
                    0, begin, machine="sim-conduction", model="sim-conduction", recording=path.name, effects=[]
                )
                shop.receive(f"shop/{MACHINE}/thermal/status", about)
            if record.log_time_ns - begin > hours * 3600.0 * NS:
                return shop
            clock.advance((record.log_time_ns - clock.now_ns) / NS)
            topic = "y/offset" if record.topic == "offset" else record.topic
            shop.receive(f"shop/{MACHINE}/thermal/{topic}", bytes(record.data))
    return shop


def main(demo: str = "demo-out", out: str = "") -> None:
    """Make both pictures."""
    folder, conduction = Path(out) if out else TOP / "compensator/report", Path(demo) / "conduction"
    photograph((conduction / "diagnosis/report.html").resolve().as_uri(), folder / "diagnosis.png", 1000, 830)
    about = {"connected": True, "where": "tcp/127.0.0.1:7447", "prefix": "shop", "ignored": 0}
    shop = filled(conduction / "with-effect" / "recordings", 12.0)
    with PageServer(shop, lambda: about, 0) as server:
        photograph(f"{server.address}#m=shop%2F{MACHINE}", folder / "live.png", 1000, 1180)


if __name__ == "__main__":
    main(*sys.argv[1:])
