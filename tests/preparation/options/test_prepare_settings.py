"""Options of `prepare` from files."""

from __future__ import annotations

import pytest

from hoigs.core.errors import SpecError
from hoigs.preparation.estimates.installed import load_options


def test_a_former_key_names_the_present_one(tmp_path) -> None:
    file = tmp_path / "options.yaml"
    file.write_text("priors:\n  masks: {use: 'estimator:masks-files'}\n")
    with pytest.raises(SpecError, match='priors: unknown key; today it is "estimators"'):
        load_options(file)


def test_options_of_the_command_line_are_named_as_there():
    with pytest.raises(SpecError) as caught:
        load_options(flags={"person_height": 170.0, "preset": "web"})
    height, estimators = sorted(str(caught.value).splitlines(), reverse=True)
    assert height == "--person-height: must be between 0.4 and 2.6 metres, got 170.0"
    assert estimators.startswith("--estimators: must be")
    with pytest.raises(SpecError, match=r"command line.*--end 2"):
        load_options(flags={"start": "5", "end": "2"})


@pytest.mark.parametrize("name", ["allow_commands", "yes"])
def test_only_the_caller_permits_commands_and_downloads(tmp_path, name: str) -> None:
    """A file beside a stranger's video, or a row of a manifest, cannot."""
    file = tmp_path / "options.yaml"
    file.write_text(f"{name}: true\n")
    with pytest.raises(SpecError, match=rf"options\.yaml:1.*{name}.*--{name.replace('_', '-')}"):
        load_options(file)
    with pytest.raises(SpecError, match=name):
        load_options(settings=[f"{name}=true"])
    assert getattr(load_options(flags={name: True}), name) is True
