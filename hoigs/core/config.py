"""ComponentConfig: the base of every component's settings."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class ComponentConfig(BaseModel):
    """Settings of one component, as they stand in a spec beside `use:`.

    Unknown keys are refused, values are checked when assigned, and loading one runs nothing. Some
    name programs that their component runs when it is used (`estimator:command`,
    `estimator:mediapipe`): a component says which in `Estimator.commands`, and `hoigs prepare`
    asks before it does.
    """

    model_config = ConfigDict(
        extra="forbid",
        validate_assignment=True,
        protected_namespaces=(),
        use_attribute_docstrings=True,
        allow_inf_nan=False,
    )
