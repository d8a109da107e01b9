"""P08, P09 and P11: how a plugin declares a component."""

from __future__ import annotations

from importlib import metadata

from hoigs.core.registry.component import API
from hoigs.core.registry.manager import Status
from hoigs.testing.checks import CheckError
from hoigs.testing.plugin.subject import CHECKS, PluginSubject, has_extra, installed

LONGEST = 100  # characters of a summary, which has one line in the listing


@CHECKS.check("P08")
def it_can_be_used_by_its_key(subject: PluginSubject) -> None:
    """The component is usable: a valid key, this API version, no conflict, nothing missing."""
    api, offer = subject.component.api, subject.offer
    if api != API:
        raise CheckError(f"api is {api}, this hoigs has {API}")
    subject.registry.check(offer)
    if offer.status is not Status.OK:
        raise CheckError(f"{offer.status}: {offer.error}")


@CHECKS.check("P09")
def summary_is_one_line(subject: PluginSubject) -> None:
    """The summary is one line."""
    summary = subject.component.summary
    if not summary.strip():
        raise CheckError("summary is empty; `hoigs plugins` shows it beside the key")
    if len(summary.splitlines()) > 1 or len(summary) > LONGEST:
        raise CheckError(f"summary is not one line of at most {LONGEST} characters: {summary!r}")


@CHECKS.check("P11", has_extra, installed)
def extra_exists_in_the_distribution(subject: PluginSubject) -> None:
    """The extra that it declares is one that its distribution offers."""
    dist, extra = subject.offer.plugin.dist, subject.component.extra
    offered = metadata.metadata(dist).get_all("Provides-Extra") or []
    if extra not in offered:
        raise CheckError(f'"{extra}" is not an extra of {dist}, which has {offered or "none"}')
