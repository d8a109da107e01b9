"""Strict YAML and TOML with positions."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hoigs.core.errors import SpecError
from hoigs.core.spec.loader import (
    MAX_BYTES,
    dump_yaml,
    load_overrides,
    load_toml,
    load_yaml,
    read_document,
)


def yaml(text: str):
    return load_yaml(text, "my.yaml")


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 0.001), ("1E3", 1000.0), ("-.5", -0.5), ("3.", 3.0), ("017", 17), ("0x1F", 31),
        ("0o17", 15), ("+4", 4), (".inf", math.inf), ("-.Inf", -math.inf), ("true", True),
        ("False", False), ("~", None), ("", None), ("null", None), ("on", "on"), ("yes", "yes"),
        ("12:30", "12:30"), ("2024-01-01", "2024-01-01"), ("1_000", "1_000"), ("'1'", "1"),
        ("1.2.3", "1.2.3"), ("e3", "e3"), ("deformation:chs", "deformation:chs"), ("-", "-"),
    ],
)  # fmt: skip
def test_scalars(text, value):
    if text == "-":
        text = "'-'"
    found = yaml(f"a: {text}").data["a"]
    assert found == value and type(found) is type(value)


def test_nan():
    assert math.isnan(yaml("a: .nan").data["a"])


def test_positions():
    document = yaml("a: 1\nblock:\n  flow: {x: [5, 6], y: {z: 3}}\n")
    assert document.data == {"a": 1, "block": {"flow": {"x": [5, 6], "y": {"z": 3}}}}
    assert document.where(("block", "flow", "y", "z")) == "my.yaml:3:28"
    assert document.where(("block", "flow", "y", "z"), key=True) == "my.yaml:3:25"
    assert document.where(("block", "flow", "x", 1)) == "my.yaml:3:17"
    # what is absent has the position of what is around it
    assert document.where(("block", "flow", "w", "q")) == "my.yaml:3:9"
    assert document.where(("nothing",)) == "my.yaml:1:1"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "a: 1\nb: {c: 1, c: 2}",
            "my.yaml:2:11 b.c: this key is given twice; first at my.yaml:2:5",
        ),
        ("a: &x [1]\nb: *x", "my.yaml:2:4: aliases"),
        ("a: {<<: *x}", "my.yaml:1:9: aliases"),
        ("a: !!python/object/apply:os.system ['true']", "my.yaml:1:4: the tag"),
        ("a: !!int b", "my.yaml:1:4: 'b' is no int"),
        ("a: !!bool x", "my.yaml:1:4: 'x' is no bool"),
        ("a: 0x" + "f" * 5000, "my.yaml:1:4: a number of 5002 digits"),
        ("a: !mine 3", "my.yaml:1:4: the tag !mine"),
        ("a: !!set {b}", "my.yaml:1:4: the tag"),
        ("- 1", "my.yaml:1:1: expected `key: value` lines, got a list"),
        ("just words", "my.yaml:1:1: expected `key: value` lines, got the text 'just words'"),
        ("? [a]\n: 1", "my.yaml:1:3: a key must be text"),
        ("a: [1\nb: 2", "my.yaml:2:2: "),
        ("a: 1\n\tb: 2", "my.yaml:2:1: "),
        ("a: 1\n---\nb: 2", "my.yaml:2:1: "),
        ("", "my.yaml: the file is empty"),
        ("# nothing", "my.yaml: the file is empty"),
        ("a: \x00", "my.yaml: "),
        ("a: " + "[" * 20_000, "my.yaml: nested too deeply"),
        ("a: " + "x" * MAX_BYTES, f"my.yaml: {MAX_BYTES + 3} characters"),
    ],
)
def test_what_is_refused(text, message):
    with pytest.raises(SpecError) as caught:
        yaml(text)
    assert str(caught.value).startswith(message)


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False)
    | st.text(st.characters(codec="utf-8", categories=("L", "N", "P", "Zs")), max_size=12)
    | st.sampled_from(["1e-3", "true", "yes", "null", "0x1", "~", "12:30", "", ".inf", "- a"]),
    lambda inner: st.lists(inner, max_size=3)
    | st.dictionaries(st.from_regex(r"[a-z][a-z0-9_]{0,6}", fullmatch=True), inner, max_size=3),
    max_leaves=12,
)  # fmt: skip


@given(st.dictionaries(st.sampled_from(["a", "b", "no", "1"]), values, min_size=1))
def test_what_is_written_is_read_back(data):
    assert yaml(dump_yaml(data)).data == data


def test_equal_parts_are_written_out_not_aliased():
    shared = {"x": [1]}
    assert yaml(dump_yaml({"a": shared, "b": shared})).data == {"a": shared, "b": shared}


TOML = """
name = "mine"
[model.object]
points = 30
deformation = {use = "deformation:chs", keyframe_step = 2}
  [train]  # how
  "steps" = 5
"""


def test_toml():
    document = load_toml(TOML, "my.toml")
    assert document.data["model"]["object"]["deformation"]["keyframe_step"] == 2
    assert document.where(("name",)) == "my.toml:2:8"
    assert document.where(("model", "object", "points"), key=True) == "my.toml:4:1"
    assert document.where(("model", "object", "deformation", "use")) == "my.toml:5:15"
    assert document.where(("train", "steps"), key=True) == "my.toml:7:3"


def test_toml_that_is_none():
    with pytest.raises(SpecError, match=r"^my\.toml:2:5: Invalid value"):
        load_toml("a = 1\nb = @", "my.toml")
    with pytest.raises(SpecError, match=r"^my\.toml: Cannot overwrite"):
        load_toml("a = 1\na = 2", "my.toml")
    with pytest.raises(SpecError, match=r"^my\.toml: .* digits"):
        load_toml("a = " + "9" * 5000, "my.toml")
    with pytest.raises(SpecError, match=r"^my\.toml: nested"):
        load_toml("a = " + "[" * 3000, "my.toml")


def test_overrides():
    document = load_overrides(["a.b=1e-3", "a.c={x: [1]}", "d=", "e=text with = in it"])
    assert document.data == {
        "a": {"b": 0.001, "c": {"x": [1]}},
        "d": None,
        "e": "text with = in it",
    }
    assert document.where(("a", "b")) == "--set a.b=1e-3:"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["a"], "--set a: expected KEY.KEY=VALUE"),
        (["=3"], "--set =3: expected KEY.KEY=VALUE"),
        (["a..b=3"], "--set a..b=3: expected KEY.KEY=VALUE"),
        (["a=1", "a.b=2"], "--set a.b=2: a has been set to 1"),
        (["a=[1"], "--set a=[1: '[1' is not a valid YAML value: "),
    ],
)
def test_overrides_that_are_none(settings, message):
    with pytest.raises(SpecError) as caught:
        load_overrides(settings)
    assert str(caught.value).startswith(message)


def test_merging():
    below = load_yaml("a: {x: 1, y: [1, 2]}\nb: {use: one, p: 1, q: {r: 2}}", "below")
    over = load_yaml("a: {y: [3]}\nb: {use: two, s: 4}\nc: {d: 1}", "over")
    merged = below.merged(over)
    assert merged.data == {
        "a": {"x": 1, "y": [3]},
        "b": {"use": "two", "s": 4},  # another component: none of the settings below fit it
        "c": {"d": 1},
    }
    where = {"a.x": "below:1:8", "a.y.0": "over:1:9", "b.s": "over:2:18", "c.d": "over:3:8"}
    for name, position in where.items():
        place = tuple(int(p) if p.isdigit() else p for p in name.split("."))
        assert merged.where(place) == position
    assert not [p for p in merged.keys if p[:2] in {("b", "p"), ("b", "q")}]
    assert ("a", "y", 1) not in merged.values
    assert below.data["a"] == {"x": 1, "y": [1, 2]}  # neither document has changed
    same = below.merged(load_yaml("b: {use: one, q: {t: 3}}", "over"))
    assert same.data["b"] == {"use": "one", "p": 1, "q": {"r": 2, "t": 3}}


def test_files(tmp_path):
    (tmp_path / "a.toml").write_text("x = 1")
    (tmp_path / "a.yaml").write_text("x: 2")
    (tmp_path / "b.yaml").write_bytes(b"x: \xff")
    assert read_document(tmp_path / "a.toml").data == {"x": 1}
    assert read_document(tmp_path / "a.yaml").data == {"x": 2}
    with pytest.raises(SpecError, match="UTF-8"):
        read_document(tmp_path / "b.yaml")
    with pytest.raises(SpecError, match="no such file"):
        read_document(tmp_path / "c.yaml")
    with pytest.raises(SpecError, match="is a folder"):
        read_document(tmp_path)
