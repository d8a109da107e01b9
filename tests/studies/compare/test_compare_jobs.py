"""Jobs that are done stay done, those that stopped go on, those that fail stop no other."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import pytest

from hoigs.cli.main import main
from hoigs.core.errors import ClipError
from hoigs.studies.compare import run as studies
from hoigs.studies.compare.data import points_of
from hoigs.studies.compare.paper import TABLES
from hoigs.studies.compare.run import ONLY_BUILTIN, Comparison, plan, run_comparison
from hoigs.studies.compare.write import write_chart
from hoigs.studies.execution.local import LocalExecutor
from hoigs.studies.jobs.job import Job, JobState, digest_folder
from hoigs.studies.jobs.results import Row
from hoigs.studies.jobs.run_jobs import run_jobs
from hoigs.studies.jobs.worker import run_job
from hoigs.training.session import Session
from hoigs.training.trainer import Trainer

CLIP = "builtin:carry?frames=8&width=32&samples=1&edge_samples=1&held_out_views=0&test_frames=2"
QUICK = ("train.preview_every=0", "model.scene.points=200", "train.checkpoint_every=2")
ROWS = (
    Row("still", "static", paper=("hosnerf/hoigs", "object-prior/depth")),
    Row("wrong", "static", ("entities=[nobody]",)),
    Row("other", None, why="nobody has it"),
)


pytestmark = pytest.mark.usefixtures("own_caches")


def _study(out: Path, rows: tuple[Row, ...] = ROWS, **more: object) -> Comparison:
    return Comparison(
        [CLIP], {"toy": rows}, out, **{"seeds": 1, "budgets": [4], "settings": QUICK, **more}
    )


def _jobs(study: Comparison) -> list[Job]:
    return [planned.job for planned in plan(study) if planned.job is not None]


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory):
    """A study with a good row, one that fails, and one that cannot be run."""
    out = tmp_path_factory.mktemp("study")
    words: list[tuple[str, str]] = []
    study = _study(out)
    cells = run_comparison(
        study,
        executor=LocalExecutor(2, threads=1),
        report=lambda job, word: words.append((job.folder.name, word)),
    )
    return study, cells, words


def test_a_failed_job_is_told_and_stops_no_other(done) -> None:
    _, cells, words = done
    still, wrong, other = cells
    assert (
        still.values["psnr_full"] > 5
        and still.values["psnr_full"] == (still.values["test frames/full/psnr"])
    )
    assert "nobody" in wrong.missing and other.missing == "nobody has it"
    assert sorted(word.partition(":")[0] for _, word in words) == sorted(
        ["started"] * 2 + ["done", "failed"]
    )


def test_rows_of_a_table_stand_beside_the_papers(done, tmp_path, monkeypatch) -> None:
    study, cells, _ = done
    monkeypatch.setitem(TABLES, "toy", ROWS)
    write_chart(cells, tmp_path, {"clips": CLIP})
    text = (tmp_path / "chart.md").read_text()
    rows = list(csv.DictReader(io.StringIO((tmp_path / "chart.csv").read_text())))
    scores = json.loads((study.out / cells[0].run / "evaluation.json").read_text())["scores"]
    for region in ("full", "human_object", "human", "object", "interaction"):
        (score,) = [s for s in scores if (s["region"], s["metric"]) == (region, "psnr")]
        (row,) = [r for r in rows if (r["table"], r["spec"], r["measure"]) ==
                  ("toy", "still", f"test frames/{region}/psnr")]  # fmt: skip
        assert float(row["value"]) == pytest.approx(score["value"])
        assert f"{score['value']:.2f}" in text
    # the paper's numbers stand apart, with table and data, and its own average where it differs
    mine, _, theirs = text.partition("**on other data**")
    assert "nobody has it" in theirs and "Table 1" not in mine
    assert "Table 1, HOSNeRF | 25.89" in theirs
    assert "supplement, Table D, HOSNeRF | 24.61 (printed: 25.36)" in theirs


def test_what_is_done_is_not_run_again(done, monkeypatch: pytest.MonkeyPatch) -> None:
    study, _, _ = done
    (job, *_) = _jobs(study)
    before = (job.folder / "evaluation.json").stat().st_mtime_ns
    words = []
    assert run_jobs([job], report=lambda job, word: words.append(word)) == {}
    assert words == ["done before"]
    monkeypatch.setattr(Session, "open", lambda *a, **k: pytest.fail("trained again"))
    run_job(job)
    assert (job.folder / "evaluation.json").stat().st_mtime_ns == before


def test_another_clip_or_spec_is_another_job(done) -> None:
    study, _, _ = done
    job = _jobs(study)[0]
    assert job.state() is JobState.done
    longer = _jobs(_study(study.out, budgets=[5]))[0]
    seeded = [j.run for j in _jobs(_study(study.out, ROWS[:1], seeds=3))]
    assert longer.run != job.run and len(set(seeded)) == 3 and seeded[0] == job.run
    changed = Job(**{**vars(job), "clip_digest": "0" * 64})
    assert changed.state() is JobState.absent


def test_an_interrupted_job_goes_on_from_its_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (job,) = _jobs(_study(tmp_path, ROWS[:1], settings=(*QUICK, "train.log_every=1")))
    whole = Trainer._report

    def stop(self: Trainer, terms: object) -> object:
        if self.step == 3:
            raise KeyboardInterrupt
        return whole(self, terms)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "_report", stop)
        with pytest.raises(KeyboardInterrupt):
            run_job(job)
    assert job.state() is JobState.started
    steps: list[int] = []

    def count(self: Trainer, terms: object) -> object:
        steps.append(self.step)
        return whole(self, terms)

    monkeypatch.setattr(Trainer, "_report", count)
    run_job(job)
    assert steps == [3, 4] and job.state() is JobState.done


def test_a_time_limit_ends_the_runs_and_says_so(tmp_path: Path) -> None:
    rows = (Row("long", "static"), Row("waits", "static", ("model.scene.opacity=0.3",)))
    study = _study(tmp_path, rows, budgets=[100_000])
    words: list[str] = []
    cells = run_comparison(study, limit_s=0.3, report=lambda job, word: words.append(word))
    assert words == ["started", "stopped"]
    assert all("time limit" in cell.missing for cell in cells) and not points_of(cells)


def test_a_run_that_stopped_before_its_first_checkpoint_starts_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (job,) = _jobs(_study(tmp_path, ROWS[:1]))
    with monkeypatch.context() as patch:
        patch.setattr(
            Trainer, "train", lambda self, on_step=None: (_ for _ in ()).throw(SystemExit)
        )
        with pytest.raises(SystemExit):  # as a killed process: nothing cleans up
            run_job(job)
    assert job.folder.is_dir() and job.state() is JobState.absent
    run_job(job)
    assert job.state() is JobState.done


def test_the_same_training_is_one_job_in_every_table(tmp_path: Path) -> None:
    tables = {name: TABLES[name] for name in ("ablation-interaction", "ablation-human-feature")}
    planned = plan(Comparison([CLIP], tables, tmp_path, budgets=[4], seeds=2))
    assert len(planned) == 8 and len({p.job.run for p in planned if p.job}) == 6
    rows = [row for table in TABLES.values() for row in table if row.spec]
    assert all(row.spec.endswith("@matched") for row in rows)  # of which hoigs is the yardstick


def test_settings_of_a_clip_are_for_built_in_clips_only(tmp_path: Path) -> None:
    noisy = (Row("still", "static"), Row("noisy", "static", clip_settings="noise.depth_scale=2"))
    still, other = _jobs(_study(tmp_path / "out", noisy))
    assert still.clip_digest != other.clip_digest and still.folder.parent != other.folder.parent
    recorded = tmp_path / "recorded"
    recorded.mkdir()
    (recorded / "clip.json").write_text("{}")
    rows = (Row("noisy", "static", clip_settings="noise.mask_boundary=0.3"),)
    (planned,) = plan(Comparison([str(recorded)], {"t": rows}, tmp_path / "out"))
    assert planned.job is None and planned.cell.missing == ONLY_BUILTIN
    with pytest.raises(ClipError, match="gone"):
        plan(Comparison([str(tmp_path / "gone")], {"t": ROWS}, tmp_path))


def test_a_digest_is_of_names_and_content(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("1")
    first = digest_folder(tmp_path)
    (tmp_path / "a").write_text("2")
    second = digest_folder(tmp_path)
    (tmp_path / "a").rename(tmp_path / "b")
    assert len({first, second, digest_folder(tmp_path)}) == 3


def test_the_command_refuses_what_it_does_not_know(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(studies, "run_jobs", lambda *a, **k: pytest.fail("something was run"))
    for words, nearest in (
        (["builtin:cary"], '"builtin:carry"'),
        ([CLIP, "--table", "comparisn"], '"comparison"'),
    ):
        command = ["hoigs", "study", "compare", *words, "--out", str(tmp_path / "o")]
        monkeypatch.setattr("sys.argv", command)
        with pytest.raises(SystemExit) as stop:
            main()
        assert stop.value.code == 2 and nearest in capsys.readouterr().err
    assert not (tmp_path / "o").exists()
