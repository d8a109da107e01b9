"""ComponentConfig: the base of every component's settings."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class ComponentConfig(BaseModel):
    """Settings of one component, as they stand in a spec beside `use:`.

    Unknown keys are refused, values are checked when assigned, and no config can run code.
    """

    model_config = ConfigDict(extra="forbid", validate_assignment=True, protected_namespaces=())
