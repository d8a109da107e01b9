"""The functions that options pass on the way from a command to what it is for, in order.

    python scripts/calls.py VIDEO                # `hoigs prepare` to the first decoded picture
    python scripts/calls.py --train CLIP         # `hoigs train --spec hoigs` to the SceneModel

A function counts if it is given the options or the spec, or lies on the stack between the command
and the end.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from types import FrameType

ROOT = f"{Path(__file__).resolve().parents[1] / 'hoigs'}/"
ENDS = {"prepare": "VideoPicture.__init__", "train": "SceneModel.__init__"}


class Arrived(BaseException):
    """The end is called; not an Exception, so that no handler takes it."""


class Calls:
    """What was called so far, by (file, name)."""

    def __init__(self, end: str) -> None:
        self.end, self.found = end, {}

    def note(self, frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if event != "call" or not code.co_filename.startswith(ROOT) or code.co_name[0] == "<":
            return
        names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
        key = (code.co_filename.removeprefix(ROOT), code.co_qualname)
        self.found[key] = self.found.get(key, False) or any(
            carries(frame.f_locals.get(name)) for name in names
        )
        if code.co_qualname == self.end:
            self._stack(frame)
            sys.setprofile(None)
            raise Arrived

    def _stack(self, frame: FrameType | None) -> None:
        while frame is not None and frame.f_code.co_qualname != "GuardedGroup.invoke":
            key = (frame.f_code.co_filename.removeprefix(ROOT), frame.f_code.co_qualname)
            if key in self.found:
                self.found[key] = True
            frame = frame.f_back


def carries(value: object) -> bool:
    """Whether a value is the options of a verb or a spec."""
    from hoigs.core.options import Options
    from hoigs.core.spec.schema import Spec

    return isinstance(value, Options | Spec)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source")
    parser.add_argument("--train", action="store_true", help="the source is a clip to train")
    given = parser.parse_args()
    verb = "train" if given.train else "prepare"
    words = [verb, given.source, *(["--spec", "hoigs"] if given.train else [])]
    calls = Calls(ENDS[verb])
    from hoigs.cli.main import main as command

    with tempfile.TemporaryDirectory() as folder:
        sys.argv = ["hoigs", *words, "--out", f"{folder}/out"]
        sys.setprofile(calls.note)
        try:
            command()
        except Arrived:
            counted = [key for key, counts in calls.found.items() if counts]
            for file, name in counted:
                print(f"{file}  {name}")
            print(f"{len(counted)} functions in {len({file for file, _ in counted})} modules")
        finally:
            sys.setprofile(None)


if __name__ == "__main__":
    main()
