"""The specs that come with hoigs, and the one in the reference."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from hoigs.core.spec.files import builtin_specs, builtin_summary
from hoigs.core.spec.schema import Spec


def test_every_builtin_spec_has_a_summary():
    assert {"hoigs", "static"} <= set(builtin_specs())
    for name in builtin_specs():
        assert len(builtin_summary(name)) > 20


def test_reading_specs_needs_no_torch():
    code = (
        "import sys; from hoigs.core.spec.files import builtin_specs, read_spec;"
        "[read_spec(name) for name in builtin_specs()];"
        "assert not {'torch', 'numpy', 'warp'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("name", builtin_specs())
def test_builtin_specs_are_in_order_and_read_back_equal(name):
    spec = Spec.load(name)
    assert spec.name == name
    assert Spec.parse(spec.dump()) == spec


def test_ablations_change_what_their_names_say():
    def changed(name: str) -> set[str]:
        base, other = (flat(Spec.load(n).model_dump()) for n in ("hoigs", name))
        keys = {k for k in base | other if base.get(k) != other.get(k)}
        depth = {"model": 3}  # model.object.deformation, and whatever lies in it
        parts = [k.split(".") for k in keys - {"name", "summary"}]
        return {".".join(part[: depth.get(part[0], 1)]) for part in parts}

    assert changed("hoigs-no-interaction") == {
        "interaction",
        "model.human.features",
        "model.object.features",
    }
    assert changed("hoigs-human-embedding") == {"model.human.features"}
    assert changed("hoigs-chs-fd") == {"model.object.deformation"}
    assert changed("hoigs-object-mlp") == {"model.object.deformation", "model.object.features"}
    assert len({Spec.load(name).model_hash() for name in builtin_specs()}) == len(builtin_specs())


def flat(tree, prefix=""):
    if not isinstance(tree, dict):
        return {prefix.rstrip("."): tree}
    return {k: v for key, value in tree.items() for k, v in flat(value, f"{prefix}{key}.").items()}


def test_the_spec_in_the_reference_is_one():
    page = Path(__file__).parents[3] / "docs" / "reference" / "spec.md"
    text = page.read_text().partition("```yaml\n")[2].partition("```")[0]
    spec = Spec.parse(text)
    assert spec.model["human"].body.settings["path"] == "SMPLX_NEUTRAL.npz"
    assert spec.model["human"].deformation == Spec.load("hoigs").model["human"].deformation
