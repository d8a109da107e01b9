"""Direct checks of a study, several at a time, in worker processes."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager

from hoigs.core.machine.python import safe_children
from hoigs.studies.stress.bench import TINY, Bench
from hoigs.studies.stress.capability import Capability
from hoigs.studies.stress.case import Case
from hoigs.studies.stress.check_result import CheckResult
from hoigs.studies.stress.checks import check, per_spec

STATIC = f"{TINY}&camera.path=static"  # of composed:static_camera
Composed = tuple[str, tuple[str, ...], tuple[str, ...]]  # spec, overrides, plugin files
OnResult = Callable[[str, str, CheckResult], None]


@contextmanager
def processes(workers: int, tasks: int) -> Iterator[ProcessPoolExecutor]:
    """A pool whose processes compute with one thread each."""
    spawn = multiprocessing.get_context("spawn")
    count = max(1, min(workers, tasks))
    with safe_children(), ProcessPoolExecutor(count, spawn, _one_thread) as pool:
        yield pool


def make_clips(
    names: Sequence[str], workers: int, log: Callable[[str], None] = lambda line: None
) -> None:
    """Generate the built-in clips that are not cached yet."""
    unique = list(dict.fromkeys(names))
    with processes(workers, len(unique)) as pool:
        waiting = [pool.submit(_make_clip, name) for name in unique]
        for i, done in enumerate(as_completed(waiting)):
            done.result()
            if (i + 1) % 10 == 0 or i + 1 == len(unique):
                log(f"{i + 1} of {len(unique)} clips")


def run_direct(
    cases: Sequence[Case],
    specs: Mapping[str, Composed],
    has: Mapping[str, frozenset[Capability]],
    workers: int,
    on_result: OnResult = lambda case, spec, result: None,
) -> dict[tuple[str, str], CheckResult]:
    """Results by case and label of the spec; those of hoigs' own code have the label "".

    Args:
        specs: what is composed, by label. has: capabilities of each, by label.
        on_result: called with each result as it is known.
    """
    own = [(case.id, "", case.check) for case in cases if case.check is not None]
    composed = [
        (case.id, label, case.per_spec)
        for label in specs
        for case in cases
        if case.per_spec is not None and set(case.concerns) <= has[label]
    ]
    found: dict[tuple[str, str], CheckResult] = {}
    if not own and not composed:
        return found
    with processes(workers, len(own) + len(composed)) as pool:
        waiting = {pool.submit(run_check, name): (case, label) for case, label, name in own}
        waiting |= {
            pool.submit(run_composed_check, name, specs[label]): (case, label)
            for case, label, name in composed
        }
        for done in as_completed(waiting):
            found[waiting[done]] = done.result()
            on_result(*waiting[done], done.result())
    return found


def run_check(name: str) -> CheckResult:
    """Run a check of hoigs' own code."""
    return _result(check(name))


def run_composed_check(name: str, composed: Composed) -> CheckResult:
    """Run a check of a model that is composed for it."""
    source, overrides, plugins = composed
    return _result(lambda: per_spec(name)(Bench.compose(source, overrides, plugins)))


def _result(run: Callable[[], CheckResult]) -> CheckResult:
    """A check that raises has failed; its result has the error."""
    try:
        return run()
    except Exception as error:
        return CheckResult(False, f"{type(error).__name__}: {error}")


def _one_thread() -> None:
    import torch

    torch.set_num_threads(1)


def _make_clip(name: str) -> None:
    from hoigs.runs.clip_source import clip_folder

    clip_folder(name)
