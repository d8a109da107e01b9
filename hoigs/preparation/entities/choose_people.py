"""Who of several people is followed, where nobody was clicked on: said before the long work."""

from __future__ import annotations

from collections.abc import Sequence

from hoigs.core.interfaces.estimator import FramePrompt
from hoigs.preparation.options.prepare_options import PrepareOptions, Prompt


def chosen_people(
    options: PrepareOptions, found: Sequence[FramePrompt]
) -> tuple[PrepareOptions, str]:
    """Options with prompts of the first one found, or of all, and a sentence that says so; as they
    were, and "", where fewer than two are found."""
    if len(found) < 2:
        return options, ""
    taken = found if options.everybody else found[:1]
    names = [options.human, *(f"{options.human}{k + 2}" for k in range(len(taken) - 1))]
    prompts = {
        name: Prompt(box=at.box, frame=at.frame) for name, at in zip(names, taken, strict=True)
    }
    changed = options.model_copy(
        update={
            "further_people": tuple(names[1:]),
            "prompts": {**options.prompts, **prompts},
        }
    )
    places = ", ".join(_middle(at) for at in found)
    said = f"{len(found)} people are seen in frame {found[0].frame}, at {places}: "
    if options.everybody:
        return changed, said + f"all are fitted, as {', '.join(names)}"
    return changed, said + (
        f"the one at {_middle(found[0])} is fitted (--person X,Y@FRAME chooses another, several "
        "with names, --person anna=X,Y; --person all takes everybody)"
    )


def _middle(at: FramePrompt) -> str:
    assert at.box is not None
    x0, y0, x1, y1 = at.box
    return f"{(x0 + x1) / 2:.0f},{(y0 + y1) / 2:.0f}"
