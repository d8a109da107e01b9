"""Options of `prepare` from files."""

from __future__ import annotations

import pytest

from hoigs.core.errors import SpecError
from hoigs.preparation.settings import load_options


def test_a_former_key_names_the_present_one(tmp_path) -> None:
    file = tmp_path / "options.yaml"
    file.write_text("priors:\n  masks: {use: 'estimator:masks-files'}\n")
    with pytest.raises(SpecError, match='priors: unknown key; today it is "estimators"'):
        load_options(file)
