"""Files and values that no machine has: refused in one line, in time, and nothing is overwritten."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

import msgspec
import pytest

from compensator.api.diagnosis import diagnose
from compensator.api.identification import identify
from compensator.cli import main
from compensator.config import Config, parse_config
from compensator.errors import CompensatorError, ConfigError, ModelError
from compensator.input_file import parse_toml, read_file
from compensator.model.model_file import parse_model, read_model_bytes
from compensator.recording.signature import Signer
from tests.audit.made import CONFIG

TABLE = "t_s,t_q_degc,at_degc,y_um,heat_w\n" + "".join(f"{60 * i},20.{i % 7},20.0,0.{i},30\n" for i in range(300))
#: No refusal takes longer, s, on a busy computer either.
PATIENCE_S = 60.0


Kind = TypeVar("Kind")


def refused(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """Run a command that must be refused in one line; return the line."""
    capsys.readouterr()
    began = time.monotonic()
    assert main([str(argument) for argument in arguments]) == 2
    assert time.monotonic() - began < PATIENCE_S
    line = capsys.readouterr().err
    assert line.startswith("compensator: ") and line.count("\n") == 1 and len(line) < 1000, line
    return line


def many_coefficients(count: int) -> bytes:
    """The published model with a path of many coefficients."""
    text = read_model_bytes("quill").decode()
    head, _, rest = text.partition("[paths.DTF]")
    values = ", ".join(["0.001"] * count)
    path = f'[paths.DTF]\nunit = "um/W"\nform = "sampled"\nb = [{values}]\na = [1.0, {values}]\n'
    return (head + path + "\n[" + rest.partition("\n[")[2]).encode()


@pytest.mark.parametrize("count", [21, 2000, 20_000])
def test_a_path_of_many_coefficients(tmp_path: Path, capsys: pytest.CaptureFixture[str], count: int) -> None:
    (tmp_path / "m.toml").write_bytes(many_coefficients(count))
    (tmp_path / "t.csv").write_text(TABLE)
    line = refused(capsys, "simulate", tmp_path / "t.csv", "--model", tmp_path / "m.toml", "--out", tmp_path / "o.csv")
    assert "m.toml" in line and f"b has {count} values, expected at most 20" in line
    (tmp_path / "c.toml").write_bytes(CONFIG.replace(b'file = "quill"', b'file = "m.toml"'))
    assert "expected at most 20" in refused(capsys, "check", "--config", tmp_path / "c.toml")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"a" + b".a" * 100_000 + b" = 1", "more than 32 parts"),
        (b"[" + b"a." * 100_000 + b"a]", "more than 32 parts"),
        (b"a = {" + b'"x" . ' * 40 + b"x = 1}", "more than 32 parts"),
        (b"a = " + b"[" * 100_000, "nested too deeply"),
        (b"a = " + b"9" * 400_000, "digits"),
        (b"a" * 900_000, "Expected"),
        (b'"' * 900_000, "Expected"),
        (b'"' + b'\\"' * 450_000, "Unterminated"),
        (b'a = {b = """\' """"", ' + b"c." * 40 + b"c = 1}", "more than 32 parts"),
        (b"a = {b = '''\" ''''', " + b"c." * 40 + b"c = 1}", "more than 32 parts"),
        (b"a = 1 # ' \"\n" + b"c." * 40 + b"c = 1", "more than 32 parts"),
    ],
)
def test_toml_that_takes_long(text: bytes, words: str) -> None:
    began = time.monotonic()
    with pytest.raises(ValueError, match=words):
        parse_toml(text)
    assert time.monotonic() - began < PATIENCE_S
    for parse, kind in ((parse_config, ConfigError), (parse_model, ModelError)):
        with pytest.raises(kind, match=r"x\.toml"):
            parse(text, source="x.toml")


def test_toml_may_begin_with_the_mark_of_an_editor() -> None:
    mark = "\ufeff".encode()
    assert parse_config(mark + CONFIG, source="x.toml") == parse_config(CONFIG, source="x.toml")
    assert parse_toml(mark + b"a = 1") == {"a": 1}
    with pytest.raises(ConfigError, match="Invalid statement"):
        parse_config(CONFIG + mark, source="x.toml")


@pytest.mark.parametrize("nested", ["[", '{"a":'])
def test_a_configuration_of_zenoh_that_is_nested_deeply(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], nested: str
) -> None:
    """Zenoh's parser ends the process at some 28,000 levels."""
    path = tmp_path / "z.json5"
    for count, words in ((100_000, "more than 15000 brackets"), (15_000, "z.json5")):
        path.write_text(nested * count)
        assert words in refused(capsys, "zero", "--zenoh", path, "--prefix", "shop/vmc-07")
        assert words in refused(capsys, "router", "--config", path, "--check")


def test_words_with_dots_are_no_deep_key() -> None:
    dots = b"x." * 40 + b"x"
    for quoted in (
        b'a = """' + dots + b'"""',
        b"a = '''\n" + dots + b"'''",
        b"a = 1 # " + dots,
        b'a = "' + dots + b'"',
    ):
        assert "a" in parse_toml(quoted)
    assert parse_toml(b'a = "1. 2. 3."\nb = "' + b"two words. " * 100 + b'"')["a"] == "1. 2. 3."


@pytest.mark.parametrize("file", ["/dev/zero", "/dev/stdin", "pipe", "folder", "loop", "large"])
def test_only_regular_files_of_a_size_are_read(tmp_path: Path, capsys: pytest.CaptureFixture[str], file: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "loop").symlink_to("loop")
    with (tmp_path / "large").open("wb") as large:
        large.truncate(20_000_000_000)
    path = tmp_path / file
    assert str(path) in refused(capsys, "check", "--config", path)
    (tmp_path / "t.csv").write_text(TABLE)
    assert str(path) in refused(capsys, "simulate", tmp_path / "t.csv", "--model", path, "--out", tmp_path / "o.csv")
    assert str(path) in refused(capsys, "simulate", path, "--model", "quill", "--out", tmp_path / "o.csv")
    assert str(path) in refused(capsys, "watch", "--once", "--zenoh", path)
    with pytest.raises(ConfigError, match=file):
        Signer(path)
    if file != "large":  # a recording may be as large as it likes; it is read in parts
        (tmp_path / "day.mcap").symlink_to(path)
        assert "day.mcap" in refused(capsys, "export", tmp_path / "day.mcap", "--out", tmp_path / "o.csv")


def test_a_name_of_a_file_that_is_none(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="not the name of a file"):
        read_file(Path("a\0b"), 10)


@pytest.mark.parametrize("columns", [1001, 100_000])
def test_a_table_of_many_columns(tmp_path: Path, capsys: pytest.CaptureFixture[str], columns: int) -> None:
    (tmp_path / "t.csv").write_text(",".join(f"c{i}" for i in range(columns)) + "\n" + ",".join(["1"] * columns) + "\n")
    line = refused(capsys, "identify", tmp_path / "t.csv", "--out", tmp_path / "m.toml")
    assert f"{columns} columns, expected at most 1000" in line


def test_a_table_of_too_many_rows(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("compensator.data.files.ROWS", 200)
    (tmp_path / "t.csv").write_text(TABLE)
    line = refused(capsys, "simulate", tmp_path / "t.csv", "--model", "quill", "--out", tmp_path / "o.csv")
    assert "301 rows" in line and "at most 200" in line


LIMITS = [
    ("poll_interval_s = 10.0", "poll_interval_s = 5e-324"),
    ("offset_max_um = 200.0", "offset_max_um = inf"),
    ("offset_max_um = 200.0", "offset_max_um = 1e308"),
    ("offset_max_um = 200.0", "offset_max_um = 5001.0"),
    ("offset_rate_max_um_per_min = 8.0", "offset_rate_max_um_per_min = inf"),
    ("offset_rate_max_um_per_min = 8.0", "offset_rate_max_um_per_min = nan"),
    ("offset_rate_max_um_per_min = 8.0", "offset_rate_max_um_per_min = 1001.0"),
    ("offset_rate_max_um_per_min = 8.0", "offset_rate_max_um_per_min = " + "9" * 400),
    ("rate_max_per_min = 5.0", "rate_max_per_min = inf"),
    ("predict_for_min = 10.0", "predict_for_min = 1e308"),
    ("t_q_below_at_max_k = 2.0", "t_q_below_at_max_k = inf"),
    ("rest_rate_um_per_min = 0.2", "rest_rate_um_per_min = inf"),
    *(
        (line, f"{line.partition('=')[0]}= {value}")
        for value in ("5e-324", "1e-10", "0.0")
        for line in (
            "offset_max_um = 200.0",
            "offset_rate_max_um_per_min = 8.0",
            "rate_max_per_min = 5.0",
            "stuck_after_min = 60.0",
            "predict_for_min = 10.0",
            "t_q_below_at_max_k = 2.0",
            "rest_rate_um_per_min = 0.2",
        )
    ),
    ('folder = "rec"', 'folder = ""'),
    ('folder = "rec"', 'folder = "a\\u0000b"'),
    ('name = "vmc-07"', 'name = "\\u0000"'),
]


@pytest.mark.parametrize(("before", "after"), LIMITS)
def test_limits_are_finite_and_possible(before: str, after: str) -> None:
    text = CONFIG.decode()
    assert before in text, text
    parse_config(text.encode(), source="c.toml")
    with pytest.raises(ConfigError, match=r"^c\.toml: ") as refusal:
        parse_config(text.replace(before, after).encode(), source="c.toml")
    assert "\n" not in str(refusal.value) and len(str(refusal.value)) < 300
    if "u0000" not in after:
        assert before.partition(" ")[0] in str(refusal.value)


def values_in(kind: object, of: type[Kind], where: str) -> Iterator[tuple[str, Kind]]:
    """Every value of a type in a table and in those in it; bounds of a range are checked apart."""
    for part in getattr(kind, "fields", ()):
        yield from values_in(part.type, of, f"{where}.{part.encode_name}")
    for inner in (*getattr(kind, "types", ()), *filter(None, [getattr(kind, "item_type", None)])):
        yield from values_in(inner, of, where)
    if isinstance(kind, of):
        yield where, kind


def test_every_number_of_a_configuration_has_a_smallest_and_a_largest_value() -> None:
    found = list(values_in(msgspec.inspect.type_info(Config), msgspec.inspect.FloatType, "config"))
    assert len(found) > 40
    for where, kind in found:
        assert kind.gt is None and kind.ge is not None and kind.le is not None, where
        assert kind.ge <= 0.0 or kind.ge >= 1e-9, where


def test_no_pattern_of_a_configuration_matches_before_a_line_end() -> None:
    found = values_in(msgspec.inspect.type_info(Config), msgspec.inspect.StrType, "config")
    patterns = {where: kind.pattern for where, kind in found if kind.pattern is not None}
    assert len(patterns) >= 5
    assert not {where: pattern for where, pattern in patterns.items() if not pattern.endswith(r"\Z")}


@pytest.mark.parametrize(
    "line",
    [
        "guards = {t_q_below_at_max_k = 2.0, suspect_jumps = true, jump_min_k = TINY}",
        "plausibility.residual_std_um = TINY",
        "plausibility.residual_hold_um = TINY",
        "restart.bridge_max_min = TINY",
        "probe = {std_um = 1.0, measured_max_um = 30.0, largest_um = 20.0, tolerance_um = TINY}",
    ],
)
def test_optional_limits_have_a_smallest_value(line: str) -> None:
    text = CONFIG.decode().replace("guards.t_q_below_at_max_k = 2.0\n", "") if "guards" in line else CONFIG.decode()
    parse_config(f"{line.replace('TINY', '1.0')}\n{text}".encode(), source="c.toml")
    with pytest.raises(ConfigError, match=r"^c\.toml: .* = 5e-324: expected at least \d"):
        parse_config(f"{line.replace('TINY', '5e-324')}\n{text}".encode(), source="c.toml")


@pytest.mark.parametrize("value", ["inf", "-inf", "nan", "1" + "0" * 400])
@pytest.mark.parametrize("key", ["fit_ttf_pct", "folds_rms_um", "free_run.scores.rms_um", "parts"])
def test_figures_of_a_model_file_are_finite(key: str, value: str) -> None:
    text = read_model_bytes("quill").decode().replace("fit_ttf_pct = 98.18\n", "")
    assert text.count("[provenance]\n") == 1
    own = "[{rms_um = VALUE}]" if key == "parts" else "VALUE"

    def model(number: str) -> bytes:
        return text.replace("[provenance]\n", f"[provenance]\n{key} = {own.replace('VALUE', number)}\n").encode()

    parse_model(model("1.5"), source="m.toml")
    with pytest.raises(ModelError, match=rf"^m\.toml: provenance: {key}\S* = .*, expected a finite number$") as refusal:
        parse_model(model(value), source="m.toml")
    assert len(str(refusal.value)) < 300


@pytest.mark.parametrize("bounds", ["[-inf, inf]", "[-300.0, 60.0]", "[0.0, 1e308]", "[nan, 60.0]"])
def test_ranges_of_temperatures_are_possible(bounds: str) -> None:
    text = CONFIG.decode()
    for key in ("t_q_degc = [", "range = ["):
        begin = text.index(key) + len(key) - 1
        changed = text[:begin] + bounds + text[text.index("]", begin) + 1 :]
        with pytest.raises(ConfigError, match="expected"):
            parse_config(changed.encode(), source="c.toml")
    model = read_model_bytes("quill").decode() + f"\n[validity]\nt_q_degc = {bounds}\n"
    if "[validity]" in read_model_bytes("quill").decode():
        begin = model.index("t_q_degc = [", model.index("[validity]")) + len("t_q_degc = ")
        model = read_model_bytes("quill").decode()
        model = model[:begin] + bounds + model[model.index("]", begin) + 1 :]
    with pytest.raises(ModelError, match=r"validity: t_q_degc"):
        parse_model(model.encode(), source="m.toml")


def test_a_folder_of_recordings_is_no_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "rec").write_text("")
    (tmp_path / "c.toml").write_bytes(CONFIG)
    line = refused(capsys, "check", "--config", tmp_path / "c.toml")
    assert "recording.folder = 'rec': is a file, expected a folder" in line


def test_a_loop_of_links_in_a_configuration(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "loop").symlink_to("loop")
    text = CONFIG.decode()
    for before, after in (('folder = "rec"', 'folder = "loop/x"'), ('file = "quill"', 'file = "loop/m.toml"')):
        assert before in text
        (tmp_path / "c.toml").write_text(text.replace(before, after))
        assert "loop" in refused(capsys, "check", "--config", tmp_path / "c.toml")


def test_the_output_is_no_input_and_each_model_has_its_own_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reference = tmp_path / "mod.toml"
    reference.write_bytes(read_model_bytes("quill"))
    (tmp_path / "t.csv").write_text(TABLE)
    (tmp_path / "link.toml").symlink_to(reference)
    for out in (reference, tmp_path / "link.toml"):
        line = refused(capsys, "identify", tmp_path / "t.csv", "--reference", reference, "--out", out)
        assert "is an input of this command" in line
    assert reference.read_bytes() == read_model_bytes("quill")


def test_a_wrong_reference_is_refused_before_the_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("compensator.api.identification.calibrate", lambda *_, **__: pytest.fail("fitted"))
    (tmp_path / "t.csv").write_text(TABLE)
    (tmp_path / "wrong.toml").write_text("a = 1")
    for wrong in ("wrong.toml", "missing.toml"):
        with pytest.raises(CompensatorError, match=wrong):
            identify(tmp_path / "t.csv", reference=tmp_path / wrong)


def test_a_wrong_run_for_validation_is_refused_before_the_search(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("compensator.api.diagnosis.find_effects", lambda *_, **__: pytest.fail("searched"))
    (tmp_path / "t.csv").write_text(TABLE)
    (tmp_path / "other.csv").write_text("t_s,t_q_degc,at_degc\n0,20,20\n60,20.1,20\n")
    with pytest.raises(CompensatorError, match="y_um"):
        diagnose("quill", tmp_path / "t.csv", validate=tmp_path / "other.csv")


def test_a_pipe_as_a_key_ends_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "key.pem")
    words = "from pathlib import Path; from compensator.recording.signature import Signer; import sys; "
    code = f"{words}Signer(Path(sys.argv[1]))"
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "key.pem")],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert "not a regular file" in done.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        ("identify", "t.csv", "--out", "m.toml", "--folds", "100000"),
        ("identify", "t.csv", "--out", "m.toml", "--ttf", "9", "9", "0"),
        ("demo", "--hours", "inf", "--out", "d"),
        ("demo", "--hours", "1e308", "--out", "d"),
        ("watch", "--once", "--wait", "inf", "--connect", "tcp/127.0.0.1:1"),
    ],
)
def test_numbers_of_the_command_line_are_bounded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "t.csv").write_text(TABLE)
    try:
        code = main(list(arguments))
    except SystemExit as ended:  # argparse
        code = int(str(ended.code))
    said = capsys.readouterr().err
    assert code == 2 and "expected" in said and said.count("\n") == 1 and "Traceback" not in said


def test_an_error_does_not_cite_a_whole_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "c.toml").write_bytes(b'"' + b'\\"' * 400_000 + b'" = 1\n')
    assert main(["check", "--config", str(tmp_path / "c.toml")]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and len(line) < 5000 and "c.toml" in line


def test_a_device_is_no_token(capsys: pytest.CaptureFixture[str]) -> None:
    ends = ("--connect", "tcp/127.0.0.1:1", "--bind", "127.0.0.1")
    assert "not a regular file" in refused(capsys, "watch", "--page", "--token", "/dev/zero", *ends)


@pytest.mark.parametrize("limit", ["keep_days", "keep_mb"])
def test_a_history_of_no_length_is_a_slip_of_the_pen(limit: str) -> None:
    with pytest.raises(ConfigError, match=rf"recording.{limit} = 5e-324: expected at least 1 and"):
        parse_config(
            CONFIG.replace(b"recording.folder", f"recording.{limit} = 5e-324\nrecording.folder".encode()),
            source="c.toml",
        )
