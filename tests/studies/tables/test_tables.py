"""Jobs that are done stay done, those that stopped go on, those that fail stop no other."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import pytest

from hoigs.cli.main import main
from hoigs.core.errors import HoigsError
from hoigs.studies.execution.local import LocalExecutor
from hoigs.studies.jobs.job import Job, JobState, digest_folder
from hoigs.studies.jobs.results import Row, TableSet
from hoigs.studies.jobs.run_jobs import run_jobs
from hoigs.studies.jobs.worker import run_job
from hoigs.studies.tables import run as studies
from hoigs.studies.tables.run import ONLY_BUILTIN, TABLE_SETS, Study, plan, run_study
from hoigs.studies.tables.write import write_tables
from hoigs.training.session import Session
from hoigs.training.trainer import Trainer

CLIP = "builtin:carry?frames=8&width=32&samples=1&edge_samples=1&held_out_views=0&test_frames=2"
QUICK = ("train.preview_every=0", "model.scene.points=200", "train.checkpoint_every=2")
ROWS = (
    Row("still", "static", paper=("hosnerf/hoigs", "object-prior/depth")),
    Row("wrong", "static", ("entities=[nobody]",)),
    Row("unknown", "statik"),
    Row("other", None, why="nobody has it"),
)
TABLE = TableSet("toy", "A toy table", ROWS)


pytestmark = pytest.mark.usefixtures("own_caches")


def _study(out: Path, rows: tuple[Row, ...] = ROWS, **more: object) -> Study:
    sets = [TableSet("toy", "A toy table", rows)]
    return Study([CLIP], sets, out, **{"seeds": 1, "steps": 4, "settings": QUICK, **more})


def _jobs(study: Study) -> list[Job]:
    return [cell.job for cell in plan(study) if cell.job is not None]


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory):
    """A study with a good row, one that fails, and two that cannot be run."""
    out = tmp_path_factory.mktemp("study")
    words: list[tuple[str, str]] = []
    study = _study(out)
    results = run_study(
        study,
        executor=LocalExecutor(2, threads=1),
        report=lambda job, word: words.append((job.folder.name, word)),
    )
    return study, results, words


def test_a_failed_job_is_told_and_stops_no_other(done) -> None:
    _, results, words = done
    rows = {r.row.label: r for r in results[0].rows[CLIP]}
    psnr = ("test frames", "full", "psnr")
    assert rows["still"].over_seeds(psnr).mean > 5
    assert "nobody" in str(rows["wrong"].over_seeds(psnr))
    assert 'did you mean "static"' in str(rows["unknown"].over_seeds(psnr)) or (
        'no spec "statik"' in str(rows["unknown"].over_seeds(psnr))
    )
    assert str(rows["other"].over_seeds(psnr)) == "not computed: nobody has it"
    assert sorted(word.partition(":")[0] for _, word in words) == sorted(
        ["started"] * 2 + ["done", "failed"]
    )


def test_markdown_csv_and_json_say_the_same(done, tmp_path: Path) -> None:
    study, results, _ = done
    paths = write_tables(results, tmp_path, {"clips": CLIP, "seeds": 1})
    assert sorted(p.name for p in paths) == ["tables.csv", "tables.json", "tables.md"]
    assert not list(tmp_path.glob(".*"))
    text = (tmp_path / "tables.md").read_text()
    stored = json.loads((tmp_path / "tables.json").read_text())
    rows = list(csv.DictReader(io.StringIO((tmp_path / "tables.csv").read_text())))
    run = study.out / stored["tables"][0]["runs"][0]["runs"]["0"]
    scores = json.loads((run / "evaluation.json").read_text())["scores"]
    for region in ("full", "human_object", "human", "object", "interaction"):
        (score,) = [s for s in scores if (s["region"], s["metric"]) == (region, "psnr")]
        (row,) = [r for r in rows if (r["row"], r["region"], r["metric"]) ==
                  ("still", region, "psnr") and r["source"] == "this study"]  # fmt: skip
        assert float(row["mean"]) == pytest.approx(score["value"])
        assert f"{score['value']:.2f}" in text
    assert "| wrong | not computed:" in text and text.count("nobody has it") == 1
    assert "LPIPS ↓, test frames: not computed: HOIGS_LPIPS_WEIGHTS names" in text
    assert "Geometry: not computed: the model has no separate object" in text
    # the paper's numbers stand apart, with table and data, and its own average where it differs
    mine, _, theirs = text.partition("**on other data**")
    assert "Table 1, HOSNeRF | 25.89" in theirs and "Table 1" not in mine
    assert "supplement, Table D, HOSNeRF | 24.61 (printed: 25.36)" in theirs
    published = [r for r in rows if r["source"].startswith("paper")]
    assert {r["data"] for r in published} == {"HOSNeRF"}
    assert not any(r["data"] == "HOSNeRF" for r in rows if r["source"] == "this study")


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
    longer = _jobs(_study(study.out, steps=5))[0]
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
    study = _study(tmp_path, rows, steps=100_000)
    words: list[str] = []
    (result,) = run_study(study, limit_s=0.3, report=lambda job, word: words.append(word))
    assert words == ["started", "stopped"]
    for row in result.rows[CLIP]:
        assert "the time limit came first" in str(row.over_seeds(("test frames", "full", "psnr")))


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
    sets = [TABLE_SETS["ablation-interaction"], TABLE_SETS["ablation-human-feature"]]
    cells = plan(Study([CLIP], sets, tmp_path, seeds=2, steps=4))
    assert len(cells) == 8 and len({c.job.run for c in cells if c.job}) == 6
    rows = [row for table in TABLE_SETS.values() for row in table.rows if row.spec]
    assert all(row.spec.endswith("@matched") for row in rows)  # of which hoigs is the yardstick


def test_knobs_are_for_built_in_clips_only(tmp_path: Path) -> None:
    noisy = (Row("still", "static"), Row("noisy", "static", clip_settings="noise.depth_scale=2"))
    still, other = _jobs(_study(tmp_path / "out", noisy))
    assert still.clip_digest != other.clip_digest and still.folder.parent != other.folder.parent
    recorded = tmp_path / "recorded"
    recorded.mkdir()
    (recorded / "clip.json").write_text("{}")
    rows = (Row("noisy", "static", clip_settings="noise.mask_boundary=0.3"),)
    study = Study([str(recorded)], [TableSet("t", "T", rows)], tmp_path / "out", seeds=1)
    (cell,) = plan(study)
    assert cell.job is None and cell.why == ONLY_BUILTIN
    with pytest.raises(HoigsError, match="no such clip folder"):
        plan(Study([str(tmp_path / "gone")], [TABLE], tmp_path))


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
    for words, message in (
        (["--clips", "builtin:cary"], 'did you mean "builtin:carry"?'),
        (["--clips", CLIP, "--table", "comparisn"], 'did you mean "comparison"?'),
    ):
        monkeypatch.setattr("sys.argv", ["hoigs", "tables", *words, "--out", str(tmp_path / "o")])
        with pytest.raises(SystemExit) as stop:
            main()
        assert stop.value.code == 2 and message in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


def test_the_command_writes_what_there_is(
    done, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    study, _, _ = done
    settings = [part for one in QUICK for part in ("--set", one)]
    monkeypatch.setattr("sys.argv", ["hoigs", "tables", "--clips", CLIP, "--specs", "static",
                                     "--seeds", "1", "--steps", "4", "--out", str(study.out),
                                     "--device", "cpu", *settings])  # fmt: skip
    with pytest.raises(SystemExit) as stop:
        main()
    assert not stop.value.code
    assert "done before" in capsys.readouterr().out
    text = (study.out / "tables.md").read_text()
    assert "## Chosen specs" in text and "| static |" in text
    assert "2 frames of split 'test'" in text, "numbers come with their protocol"
