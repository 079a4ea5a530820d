"""Arguments of the commands, in a separate module so that `--help` imports no numerical packages."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from pathlib import Path

from compensator.commands.outputs import (
    Reads,
    Writes,
    check_diagnosis,
    files_of_diagnosis,
    page_of_calibration,
    page_of_report,
    pages_of_demo,
)

#: A file that is read, or a folder of recordings; a file, or the name of a model.
_READ, _READ_TEXT = Reads(), Reads(str)
#: A table, a page, a folder.
_TABLE, _PAGE_FILE, _FOLDER = Writes(".csv"), Writes(".html"), Writes("")
_OPERATOR = "Zenoh configuration with the operator's certificate, such as operator.json5; needed over TLS"
_SCHEDULER = "run on this Dask scheduler, such as tcp://host:8786 (default: all cores of this computer)"


def _hash(text: str) -> str:
    """Read the beginning of a hash."""
    if re.fullmatch("[0-9a-f]{6,64}", text) is None:
        raise argparse.ArgumentTypeError(f"{text!r}: expected the first 6 or more digits of a hash, such as 055e0d2a")
    return text


def _column(parser: argparse.ArgumentParser) -> None:
    words = "use the column NAME as ROLE, such as t_q_degc, t_s, time_utc or time_h; may be repeated"
    parser.add_argument("--column", action="append", default=[], metavar="ROLE=NAME", help=words)


def _axis(parser: argparse.ArgumentParser, default: str = "all that the data have") -> None:
    words = f"axis x, y or z, or NAME of a probe with a column NAME_um; may be repeated (default: {default})"
    parser.add_argument("--axis", action="append", metavar="NAME", help=words)


def _y_std(parser: argparse.ArgumentParser) -> None:
    words = "standard deviation of one measured Y, um; needed where Y was measured now and then, as by a touch probe"
    parser.add_argument("--y-std", type=float, metavar="UM", help=words)


def _page(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--page",
        type=_PAGE_FILE,
        metavar="FILE",
        help="also write the page to this file: .html, or .pdf or .png (printed by an installed browser)",
    )


def _number(low: float, high: float) -> Callable[[str], float]:
    """Return what reads a number between two bounds (inclusive)."""

    def number(text: str) -> float:
        value = float(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text}: expected a number from {low:g} to {high:g}")
        return value

    return number


def _timeout(parser: argparse.ArgumentParser, default_s: float) -> None:
    words = f"how long to wait for the service's reply, s ({default_s:g})"
    parser.add_argument("--timeout", type=_number(0.0, 86_400.0), default=default_s, metavar="S", help=words)


def demo(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `demo`."""
    add = parser.add_argument
    add("--out", type=Writes("", pages_of_demo), default=Path("demo-out"), metavar="DIR", help="folder for the results")
    add("--hours", type=_number(0.1, 10_000.0), default=24.0, help="length of the simulated run, h (default 24)")
    add("--seed", type=int, default=1, help="seed of the simulated day (default 1)")
    add(
        "--live",
        action="store_true",
        help="one machine that continues in real time after these hours, for experiments",
    )
    add("--port", type=int, default=7447, help="with --live: port on loopback (default 7447)")
    words = "ten days of two machines, unattended: effects come and go, the loop finds and adopts them; some minutes"
    add("--loop", action="store_true", help=words)
    _page(parser)


def run(parser: argparse.ArgumentParser) -> None:
    """Describe the argument of `run` and `probe`; `adopt` and `back` have it as well."""
    parser.add_argument("--config", type=_READ_TEXT, required=True, metavar="FILE", help="configuration of the service")


probe = run


def check(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `check`."""
    run(parser)
    words = "check whether the service could run this model (a file, or quill) in place of its own"
    parser.add_argument("--model", type=_READ_TEXT, metavar="MODEL", help=words)


def simulate(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `simulate`."""
    add = parser.add_argument
    add(
        "data",
        type=_READ,
        nargs="+",
        metavar="DATA",
        help="CSV or MAT file, or recording; several files are several runs",
    )
    add("--model", type=_READ_TEXT, required=True, help="a model file, or quill")
    add("--out", type=_TABLE, required=True, metavar="CSV")
    words = "correct each row by the measured Y of earlier rows, as the service does by probes (default: run free)"
    add("--correct", action="store_true", help=words)
    _y_std(parser)
    _column(parser)
    _axis(parser, "all that the model has")


def compare(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `compare`."""
    add = parser.add_argument
    add("data", type=_READ, nargs="+", metavar="DATA", help="one or more tables (CSV, MAT), or recordings, with Y")
    words = "a model file, or quill; repeated for each model"
    add("--model", type=_READ_TEXT, action="append", required=True, metavar="MODEL", help=words)
    words = "compare from this hour of each file on; the models run from its start (0)"
    add("--from", dest="from_h", type=_number(0.0, 1e6), default=0.0, metavar="H", help=words)
    add("--out", type=_TABLE, metavar="CSV", help="also write measured Y, predictions and residuals as a table")
    _page(parser)
    _column(parser)
    _axis(parser)


def loop(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `loop`."""
    add = parser.add_argument
    words = "recordings of a machine, or a folder that contains such folders"
    add("folder", type=_READ, nargs="+", metavar="FOLDER", help=words)
    words = "without [loop] in the configuration of a machine: propose or adopt a better model (default adopt)"
    add("--policy", choices=("propose", "adopt"), default="adopt", help=words)
    add("--scheduler", metavar="ADDRESS", help=_SCHEDULER)
    _page(parser)


def export(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `export`."""
    words = "recordings of one machine in any order, or a folder of them"
    parser.add_argument("recording", type=_READ, nargs="+", metavar="FILE.mcap", help=words)
    parser.add_argument("--out", type=_TABLE, required=True, metavar="CSV")
    words = "machine in a shop's recording (watch --record), such as shop/vmc-07"
    parser.add_argument("--machine", default="", metavar="PREFIX", help=words)


def bridge(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `bridge`."""
    words = "opcua: send the offset to a control; probes: send values of touch probes to the service"
    parser.add_argument("protocol", choices=("opcua", "probes"), help=words)
    words = "TOML with [receiver] and [opcua], or with [probes] and its sources"
    parser.add_argument("--config", type=_READ_TEXT, required=True, metavar="FILE", help=words)
    parser.add_argument("--check", action="store_true", help="check the file without opening a connection")


def completion(parser: argparse.ArgumentParser) -> None:
    """Describe the argument of `completion`."""
    parser.add_argument("shell", choices=("bash", "zsh", "fish"), help="the shell")


def explain(parser: argparse.ArgumentParser) -> None:
    """Describe the argument of `explain`."""
    parser.add_argument(
        "code", metavar="CODE", nargs="?", help="such as degraded or t_q_missing (default: list all codes)"
    )


def identify(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `identify`."""
    add = parser.add_argument
    add("data", type=_READ, nargs="+", metavar="DATA", help="one or more CSV or MAT files, or recordings")
    words = "the model file; its page is written next to it"
    add("--out", type=Writes(".toml", page_of_calibration), required=True, metavar="MODEL", help=words)
    _page(parser)
    _column(parser)
    _axis(parser)
    _y_std(parser)
    add("--name", help="name of the model (default: the file name)")
    add = parser.add_argument_group("structure of the model").add_argument
    words = "heat: with a TTF; direct: from T_Q - AT to y; auto (the default): heat if heat_w is known"
    add("--kind", choices=("auto", "heat", "direct"), default="auto", help=words)
    add("--ttf", type=int, nargs=3, default=(2, 2, 0), metavar=("NB", "NF", "NK"), help="structure of the TTF (2 2 0)")
    words = "structure of DTF and TDTF (default: chosen on held-out blocks)"
    add("--order", type=int, nargs=3, metavar=("NF", "NB_DTF", "NB_TDTF"), help=words)
    words = "heat for fitting the DTF: estimated from T_Q as in the service (ttf, the default), or known"
    add("--drive", choices=("ttf", "known"), default="ttf", help=words)
    add = parser.add_argument_group("effect of the ambient temperature").add_argument
    words = "TDTF given (I), fitted to a whole ETVE (II) or its end (III), or jointly with the DTF (IV, the default)"
    add("--method", choices=("I", "II", "III", "IV"), default="IV", help=words)
    words = "method I: gain and time constant of the first-order TDTF"
    add("--tdtf", type=float, nargs=2, metavar=("UM_PER_K", "MIN"), help=words)
    words = "methods II and III: a run with the heat source off; may be repeated"
    add("--etve", type=_READ, action="append", default=[], metavar="DATA", help=words)
    add("--etve-end-h", type=float, default=6.0, metavar="H", help="method III: length of the final part, h (6)")
    add = parser.add_argument_group("validation").add_argument
    words = "a run used only for validation; may be repeated"
    add("--validate", type=_READ, action="append", default=[], metavar="DATA", help=words)
    add("--fit-until", type=float, metavar="H", help="fit up to this hour, validate on the rest")
    add("--folds", type=int, default=5, help="number of held-out blocks of time (5)")
    add("--reference", type=_READ_TEXT, metavar="MODEL", help="another model, to compare its coefficients")


def diagnose(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `diagnose`."""
    add = parser.add_argument
    add("data", type=_READ, nargs="+", metavar="DATA", help="one or more CSV or MAT files, or recordings")
    add("--model", type=_READ_TEXT, required=True, help="a model file, or quill")
    add(
        "--out",
        type=Writes("", files_of_diagnosis, check_diagnosis),
        required=True,
        metavar="DIR",
        help="folder for diagnosis.json, model.toml, report.html and series.csv",
    )
    words = "search up to this hour, validate both models on the rest"
    add("--fit-until", type=_number(0.0, 1e6), metavar="H", help=words)
    words = "data that take no part in the search, to validate both models; may be repeated"
    add("--validate", type=_READ, action="append", default=[], metavar="DATA", help=words)
    words = "keep the paths of the model even where it misses much of its own calibration, as the loop does"
    add("--keep-paths", action="store_true", help=words)
    words = "search all of the data, also where an effect began within them, and not the time since then"
    add("--all-data", action="store_true", help=words)
    _page(parser)
    _column(parser)
    _axis(parser, "all that model and data have")
    _y_std(parser)
    add("--scheduler", metavar="ADDRESS", help=_SCHEDULER)


def replay(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `replay`."""
    add = parser.add_argument
    add("recording", type=_READ, nargs="+", metavar="FILE.mcap", help="recordings, or a folder of them")
    add("--public-key", type=_READ, metavar="FILE", help="Ed25519 public key (PEM) to check the signatures")
    add("--head", type=_READ, metavar="FILE", help="with --public-key: head of the chain, which the machine keeps")
    add(
        "--model",
        type=_READ_TEXT,
        metavar="OTHER",
        help="show what this model (a file, or quill) would have done, without an audit",
    )
    add("--out", type=_TABLE, metavar="CSV", help="with --model: table of both offsets for every sample")
    _page(parser)
    add("--scheduler", metavar="ADDRESS", help=_SCHEDULER)


def report(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `report`."""
    add = parser.add_argument
    words = "recordings, a folder of them, or a folder with results of demo, identify or diagnose"
    add("what", type=_READ, nargs="+", metavar="DIR_OR_FILE", help=words)
    words = "the page: .html, or .pdf or .png (first figure only) printed by an installed browser "
    words += "(default: NAME-report.html in the current folder)"
    add("--out", type=Writes(".html", default=page_of_report), metavar="FILE", help=words)


def adopt(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `adopt`."""
    parser.add_argument("model", type=_READ_TEXT, nargs="?", metavar="MODEL", help="a model file, or quill")
    words = "adopt the model that the service proposes ([loop]): only this one, by the first digits of its hash"
    parser.add_argument("--candidate", type=_hash, nargs="?", const=True, metavar="HASH", help=words)
    words = "adopt the model even if measured Y shows that it is clearly worse, or the recordings do not determine its "
    words += "state; its standard deviation is then larger"
    _change(parser, words)


def dismiss(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `dismiss`."""
    words = "the first digits of its hash (default: the proposed one)"
    parser.add_argument("candidate", type=_hash, nargs="?", default=True, metavar="HASH", help=words)
    run(parser)
    add = parser.add_argument
    add("--zenoh", type=_READ, metavar="FILE", help=_OPERATOR)
    _timeout(parser, 5.0)


def back(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `back`."""
    words = "go back even if the recordings do not determine the model's state; its standard deviation is then larger"
    _change(parser, words)


def _change(parser: argparse.ArgumentParser, force: str) -> None:
    run(parser)
    add = parser.add_argument
    add("--zenoh", type=_READ, metavar="FILE", help=_OPERATOR)
    add("--force", action="store_true", help=force)
    _timeout(parser, 60.0)


def hold(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `hold` and `resume`; `zero` has them as well."""
    add = parser.add_argument
    add(
        "--config",
        type=_READ_TEXT,
        metavar="FILE",
        help="configuration of the service; without it, --prefix and --zenoh",
    )
    add("--prefix", metavar="PREFIX", help="zenoh.prefix of the machine, such as shop/vmc-07")
    add("--zenoh", type=_READ, metavar="FILE", help=_OPERATOR)
    _timeout(parser, 5.0)


resume = hold


def zero(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `zero`."""
    hold(parser)
    words = "rest: the machine is at rest; warm: it is not; auto (the default): the service determines which"
    parser.add_argument("--mode", choices=("auto", "rest", "warm"), default="auto", help=words)


def router(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `router`."""
    add = parser.add_argument
    add("--config", required=True, type=_READ, metavar="FILE", help="Zenoh configuration, as for zenohd")
    add("--check", action="store_true", help="check the configuration without opening a port")
    words = "write Zenoh's log to stdout; warn shows why a link is refused"
    add("--log", choices=("error", "warn", "info", "debug"), help=words)


def watch(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `watch`."""
    add = parser.add_argument
    words = "watch the service of this configuration, including the last day from its recordings"
    add("--config", type=_READ_TEXT, metavar="FILE", help=words)
    words = "connect to this endpoint, such as tcp/127.0.0.1:7447; may be repeated, the first that answers is used"
    add("--connect", action="append", default=[], metavar="ENDPOINT", help=words)
    words = "Zenoh configuration with a receiver's or operator's certificate, such as receiver.json5; needed over TLS"
    add("--zenoh", type=_READ, metavar="FILE", help=words)
    words = "watch this machine, or all machines below this prefix (default: that of the configuration, or everything)"
    add("--prefix", help=words)
    add("--once", action="store_true", help="show the state once and exit, as --json does")
    add("--wait", type=_number(0.0, 86_400.0), default=0.0, metavar="S", help="with --once: how long to listen, s (0)")
    add("--page", action="store_true", help="serve a live page on 127.0.0.1 instead of the terminal view")
    add("--port", type=int, default=8710, help="port of the page (8710; 0: any free port)")
    words = "with --page: serve it, read only and not encrypted, on this address of the computer, such as for a tablet "
    words += "at the machine; the printed address ends in a token, without which nothing is shown"
    add("--bind", metavar="ADDRESS", help=words)
    words = "with --bind: file with the token, made if it does not exist (default: a new token at each start)"
    add("--token", type=_READ, metavar="FILE", help=words)
    words = "record all messages of all machines as MCAP in this folder"
    add("--record", type=_FOLDER, metavar="FOLDER", help=words)
    add("--foxglove", action="store_true", help="serve Foxglove on 127.0.0.1 (needs the extra foxglove)")
    add("--foxglove-port", type=int, default=8765, metavar="PORT", help="port for Foxglove (8765)")
    words = "let pages of this origin connect to Foxglove's port, besides Foxglove itself; may be repeated"
    add("--foxglove-origin", action="append", default=[], metavar="ORIGIN", help=words)
