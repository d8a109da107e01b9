"""Direct checks of a study, several at a time in processes of their own."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager

from hoigs.studies.stress.bench import TINY, Bench
from hoigs.studies.stress.capability import Capability
from hoigs.studies.stress.case import Case
from hoigs.studies.stress.checks import check, per_spec
from hoigs.studies.stress.finding import Finding

STATIC = f"{TINY}&camera.path=static"  # of composed:static_camera
Composed = tuple[str, tuple[str, ...], tuple[str, ...]]  # spec, overrides, plugin files
Told = Callable[[str, str, Finding], None]


@contextmanager
def processes(workers: int, tasks: int) -> Iterator[ProcessPoolExecutor]:
    """A pool whose processes compute with one thread each."""
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max(1, min(workers, tasks)), spawn, _one_thread) as pool:
        yield pool


def make_clips(
    names: Sequence[str], workers: int, tell: Callable[[str], None] = lambda line: None
) -> None:
    """Generate the built-in clips that are not cached yet."""
    unique = list(dict.fromkeys(names))
    with processes(workers, len(unique)) as pool:
        waiting = [pool.submit(_make_clip, name) for name in unique]
        for i, done in enumerate(as_completed(waiting)):
            done.result()
            if (i + 1) % 10 == 0 or i + 1 == len(unique):
                tell(f"{i + 1} of {len(unique)} clips")


def run_direct(
    cases: Sequence[Case],
    specs: Mapping[str, Composed],
    has: Mapping[str, frozenset[Capability]],
    workers: int,
    told: Told = lambda case, spec, finding: None,
) -> dict[tuple[str, str], Finding]:
    """Findings by case and label of the spec; those of our own code under the label "".

    Args:
        specs, has: by label, what is composed and what it has.
        told: called with each as it comes.
    """
    own = [(case.id, "", case.check) for case in cases if case.check is not None]
    composed = [
        (case.id, label, case.per_spec)
        for label in specs
        for case in cases
        if case.per_spec is not None and set(case.concerns) <= has[label]
    ]
    found: dict[tuple[str, str], Finding] = {}
    if not own and not composed:
        return found
    with processes(workers, len(own) + len(composed)) as pool:
        waiting = {pool.submit(ask, name): (case, label) for case, label, name in own}
        waiting |= {
            pool.submit(ask_composed, name, specs[label]): (case, label)
            for case, label, name in composed
        }
        for done in as_completed(waiting):
            found[waiting[done]] = done.result()
            told(*waiting[done], done.result())
    return found


def ask(name: str) -> Finding:
    """The answer of a check of our own code."""
    return _answer(check(name))


def ask_composed(name: str, composed: Composed) -> Finding:
    """The answer of a check of a model that is composed for it."""
    source, overrides, plugins = composed
    return _answer(lambda: per_spec(name)(Bench.compose(source, overrides, plugins)))


def _answer(question: Callable[[], Finding]) -> Finding:
    """A check that cannot finish has failed, and says with what."""
    try:
        return question()
    except Exception as error:
        return Finding(False, f"{type(error).__name__}: {error}")


def _one_thread() -> None:
    import torch

    torch.set_num_threads(1)


def _make_clip(name: str) -> None:
    from hoigs.training.clip_source import clip_folder

    clip_folder(name)
