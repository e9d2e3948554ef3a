"""The campaign: real training and tests, stopped in every way and gone on with."""

import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml
from matplotlib import image

from izoo.benchmarks.campaign import __main__ as campaign
from izoo.benchmarks.campaign.__main__ import CampaignConfig
from izoo.benchmarks.campaign.experiment import read_experiment
from izoo.benchmarks.campaign.jobs import PartRun
from izoo.benchmarks.campaign.learning_curves import costs, draw_curves, update_learning
from izoo.benchmarks.campaign.summing_up import agreement, beside_paper, headroom, on_front
from izoo.conf.train_options import TrainConfig
from izoo.errors import IzooError
from izoo.files import claimed
from izoo.leaderboard import main as leaderboard
from izoo.metrics.paper_form import paper_form
from izoo.metrics.summary import summarise
from izoo.report.report_data import collect
from izoo.results import read_table
from izoo.results.store import read_manifest
from izoo.training import checkpoint
from izoo.training.loggers import MetricsTable
from izoo.training.run_folder import owned, read_config, write_config
from tests.conftest import Refused
from tests.report.made_tables import table

TRAIN = ["algo=ppo", "algo.hidden=[8]", "algo.frames_per_batch=40", "algo.epochs=1", "num_envs=4"]
TRAIN += ["checkpoint.every_batches=1", "twin.compare_every=0"]
VALIDATED = ["validation.every_batches=5", "validation.contexts=2"]
CONTENT = {
    "entries": {"ppo": {"train": TRAIN}, "glide": {"policy": "glide", "glide": {"floor_mps": 3}}},
    "parts": {
        "lane": {
            **{"task": "busy_lane", "entries": ["glide", "ppo_untrained", "ppo"]},
            **{"train": ["total_frames=200", *VALIDATED], "seeds": 1, "contexts": 2, "training_contexts": 2},
        }
    },
}
REFERENCE = Path(__file__).parents[2] / "results/reference"
ENTRIES = {"human", "uncommanded", "glide", "ppo_untrained", "ppo"}


def words(folder: Path, *more: str, **lane: object) -> list[str]:
    """Options of a campaign of one part, which may differ from :data:`CONTENT`."""
    part = {**CONTENT["parts"]["lane"], **lane}
    path = folder.parent / f"{folder.name}.yaml"
    path.write_text(yaml.safe_dump({**CONTENT, "parts": {"lane": part}}))
    return [f"experiment={path}", f"out={folder}", "threads=1", "num_workers=0", *more]


def start(folder: Path, *more: str, **lane: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "izoo.benchmarks.campaign", *words(folder, *more, **lane)]
    return subprocess.Popen(command, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)


def wait_for_frames(folder: Path, frames: int, process: subprocess.Popen[str]) -> None:
    """Wait until the first run has a checkpoint of so many frames."""
    end = time.monotonic() + 240
    while time.monotonic() < end and process.poll() is None:
        found = checkpoint.listed(folder / "lane" / "train" / "ppo" / "seed0")
        if found and checkpoint.frames_of(found[-1]) >= frames:
            return
        time.sleep(0.02)
    process.kill()
    pytest.fail(f"no checkpoint of {frames} frames: {process.communicate()[0]}")


def wait_until_nobody_trains(run_dir: Path) -> None:
    """A run in a process of its own notices that the campaign is gone, and saves its state."""
    end = time.monotonic() + 60
    while True:
        try:
            with owned(run_dir):
                return
        except IzooError:
            assert time.monotonic() < end
            time.sleep(0.1)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished campaign."""
    folder = tmp_path_factory.mktemp("results") / "a"
    assert campaign.main(words(folder)) == 0
    return folder


def assert_everything_is_there(folder: Path, seeds: int = 1, frames: int = 200) -> None:
    part = folder / "lane"
    assert read_manifest(part).complete
    assert image.imread(part / "saved.png").shape[2] == 4
    rows = read_table(part)
    assert set(rows["policy"]) == ENTRIES and set(rows["task"]) == {"busy_lane", "busy_lane, training contexts"}
    played = rows.groupby(["policy", "train_seed"])["seed"].size()
    assert played["ppo"].tolist() == [4] * seeds and played["glide"].tolist() == [4 * seeds]
    logged = [line.split(",")[0] for line in (part / "train/ppo/seed0/metrics.csv").read_text().splitlines()[1:]]
    assert [int(number) for number in logged] == list(range(40, frames + 1, 40)), "a batch was lost or counted twice"
    (summary,) = json.loads((part / "summary.json").read_text())
    written = {path.stem for path in (part / "leaderboard").glob("*.json")}
    assert summary["entries"]["ppo"]["train_seeds"] == seeds
    assert written == set(summary["gaps"]) == ENTRIES - {"human", "uncommanded"}
    text = (folder / "tables.md").read_text()
    assert "| ppo" in text and "Generalisation gap" in text and "Cost of a training run" in text
    assert summary["verdict"] in text and "Still missing" not in text


@pytest.mark.slow
def test_everything_is_there(done: Path) -> None:
    assert image.imread(done / "lane" / "curves.png").shape[2] == 4
    assert_everything_is_there(done)
    part = done / "lane"
    record = read_manifest(part).policies["ppo"][0]
    assert (record.kind, record.algo, record.frames) == ("trained", "ppo", 200) and record.weights
    assert (part / str(record.source)).is_file()
    assert leaderboard(["validate", str(part / "leaderboard" / "ppo.json")]) == 0
    (evaluation,) = collect(part).evaluations
    assert set(evaluation.policies) == ENTRIES - {"human"} and list(collect(part).curves) == ["ppo"]
    names = ["co2_saved", "delay_change_s", "co2_saved-core_h", "delay_change_s-core_h"]
    assert [chart.name for chart in draw_curves(update_learning(part))] == names


@pytest.mark.slow
@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("runs_at_once", [1, 2])
def test_a_campaign_that_was_stopped_by_ctrl_c_and_then_killed_goes_on(tmp_path: Path, runs_at_once: int) -> None:
    folder, more, lane = tmp_path / "a", [f"runs_at_once={runs_at_once}"], {"seeds": runs_at_once}
    lane["train"] = ["total_frames=600", *VALIDATED]

    def frames() -> int:
        return checkpoint.frames_of(checkpoint.listed(folder / "lane/train/ppo/seed0")[-1])

    def is_missing() -> bool:
        assert campaign.main([*words(folder, **lane), "play=false"]) == 0
        return "Still missing: " in (folder / "tables.md").read_text()

    process = start(folder, *more, **lane)
    wait_for_frames(folder, 40, process)
    process.send_signal(signal.SIGINT)
    output = process.communicate(timeout=120)[0]
    assert process.returncode == 130 and "the same command goes on where it stopped." in output, output
    assert is_missing()
    process = start(folder, *more, **lane)
    wait_for_frames(folder, frames() + 40, process)
    process.kill()
    process.communicate()
    for seed in range(runs_at_once):
        wait_until_nobody_trains(folder / f"lane/train/ppo/seed{seed}")
    assert frames() < 600 and is_missing()
    assert campaign.main([*words(folder, **lane), *more]) == 0
    assert_everything_is_there(folder, runs_at_once, 600)


@pytest.mark.slow
def test_a_second_start_does_nothing_and_more_is_added(
    done: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = Path(shutil.copytree(done, tmp_path / "copy"))
    before = (copy / "lane" / "rows.csv").read_bytes()
    assert campaign.main(words(copy)) == 0
    assert "6 of 6 jobs are done already" in capsys.readouterr().out
    assert (copy / "lane" / "rows.csv").read_bytes() == before
    assert campaign.main(words(copy, contexts=3, simulators=["twin", "sumo"], sumo_seeds=1)) == 0
    rows = read_table(copy / "lane")
    assert (copy / "lane" / "rows.csv").read_bytes().startswith(before) and set(rows["simulator"]) == {"sumo", "twin"}
    assert set(rows.loc[rows["simulator"] == "sumo", "task"]) == {"busy_lane"}, "SUMO plays the test alone"
    (summary,) = json.loads((copy / "lane" / "summary.json").read_text())
    assert summary["simulators"] == ["twin"] and summary["gaps"]
    found = agreement(rows[rows["task"] == "busy_lane"])
    assert found is not None and found.columns[-2:] == ("SUMO", "the twin")
    assert "ppo" in [row.label for row in found.rows]
    said = capsys.readouterr().out.rstrip().splitlines()
    assert said[-1].startswith("lane: ") and said[-1].endswith(".")


@pytest.mark.slow
def test_what_does_not_belong_to_the_campaign_is_refused(done: Path, tmp_path: Path, refused: Refused) -> None:
    copy = Path(shutil.copytree(done, tmp_path / "copy"))
    assert "-> 0.9" in refused(campaign.main, words(copy, train=["algo.gamma=0.9"]), "algo.gamma")
    with claimed(copy / "lane"):
        refused(campaign.main, words(copy), "another process")
    with owned(copy / "lane/train/ppo/seed0"):
        said = "this run is being trained; wait for its end, or stop it"
        refused(campaign.main, words(copy, train=["total_frames=240"]), said)
    config = read_config(copy / "lane" / "train/ppo/seed0")
    assert config.env.decide == "vehicle" and config.contexts.name == "pcg"


@pytest.mark.slow
def test_rows_do_not_outlive_the_weights_that_were_tested(done: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(done, tmp_path / "copy"))
    before = read_table(copy / "lane")
    *_, other, newest = checkpoint.listed(copy / "lane/train/ppo/seed0")
    shutil.copy(other, newest)  # as if it had been trained otherwise
    assert campaign.main(words(copy)) == 0
    after = read_table(copy / "lane")
    same = after["policy"] != "ppo"
    assert after[same].equals(before[same]) and not after[~same].equals(before[~same]) and len(after) == len(before)


def test_bad_options_are_one_sentence(refused: Refused) -> None:
    refused(campaign.main, ["parts=[busy]"], "busy_lane")
    refused(campaign.main, ["runs_at_once=0"], "runs_at_once is 0")
    refused(campaign.main, ["out="], "out is empty")


def test_nothing_is_written_where_nothing_was_played(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert campaign.main(["play=false", f"out={tmp_path / 'none'}"]) == 0
    said = capsys.readouterr().out
    assert "Still missing: 11 jobs" in said and "tables.md" not in said and not list(tmp_path.iterdir())


def test_the_front_is_what_no_other_entry_beats() -> None:
    made = table({"a": (0.06, 5.0, 1), "b": (0.03, 0.0, 1), "c": (0.02, 1.0, 1), "d": (0.0, -1.0, 1)})
    assert sorted(on_front(summarise(made))) == ["a", "b", "d"]


def test_headroom_is_a_share_of_what_the_planner_saves() -> None:
    made = table({"ppo": (0.03, 0.0, 4), "planner": (0.06, 0.0, 1)})
    made = made[(made["policy"] != "planner") | (made["context_id"] < 8)]
    found = headroom(made)
    assert found is not None and "8 contexts" in found.title
    shares = {row.label: row.cells[1] for row in found.rows}
    assert shares["planner"] == "100 %" and 45 < int(str(shares["ppo"]).split()[0]) < 56


def keep_some(part: Path, *entries: str) -> None:
    """Leave rows of baselines and of a few entries: summing up all of them takes a minute."""
    head, *lines = (part / "rows.csv").read_text().splitlines(keepends=True)
    kept = {f",{entry}," for entry in (*entries, "human", "uncommanded")}
    lines = [line for line in lines if line == "\n" or any(name in line for name in kept)]
    (part / "rows.csv").write_text(head + "".join(lines))


@pytest.mark.slow
def test_the_planner_stands_beside_no_entry(tmp_path: Path) -> None:
    """In the rows of the repository, which the page of results shows."""
    shutil.copytree(REFERENCE / "busy_lane", tmp_path / "busy_lane")
    keep_some(tmp_path / "busy_lane", "glide", "ppo", "ppo_stop", "cmaes", "planner")
    rows = tmp_path / "busy_lane" / "rows.csv"
    rows.write_text("".join(line for line in rows.open() if ",cmaes,3," not in line))
    assert "planner" in set(read_table(tmp_path / "busy_lane")["policy"])
    assert campaign.main(["experiment=reference", "parts=[busy_lane]", "play=false", f"out={tmp_path}"]) == 0
    tables, _, rest = (tmp_path / "tables.md").read_text().partition("Headroom")
    assert "planner" not in tables and "| planner |" in rest
    assert "| ppo\\_stop | 4 |" in rest.partition("Cost of a training run")[2]
    (evaluation,) = collect(tmp_path / "busy_lane", partial=True).evaluations
    assert "planner" not in evaluation.policies and "glide" in evaluation.policies
    written = {path.stem for path in (tmp_path / "busy_lane/leaderboard").glob("*.json")}
    assert {"ppo", "glide"} <= written and "cmaes" not in written, "one of its seeds is missing"
    assert leaderboard(["validate", str(tmp_path / "busy_lane/leaderboard")]) == 0, "all are ranked"
    run = PartRun(read_experiment("reference"), "busy_lane", tmp_path, CampaignConfig())
    run.store.read(mend=False)
    trained = {job.entry for job in run.missing() or [] if job.kind == "train"}
    assert "cmaes" in trained and "ppo_stop" not in trained, "its run is gone, but everything has been played"


@pytest.mark.slow
def test_rows_are_summed_up_without_the_dataset(tmp_path: Path) -> None:
    shutil.copytree(REFERENCE / "measured", tmp_path / "measured")
    keep_some(tmp_path / "measured", "glide", "ppo")
    assert campaign.main(["experiment=reference", "parts=[measured]", "play=false", f"out={tmp_path}"]) == 0
    text = (tmp_path / "tables.md").read_text()
    assert "Give dataset=FOLDER" in text and "CO2 saved" in text and "Still missing" not in text
    assert not (tmp_path / "measured/leaderboard").exists()


def test_in_the_papers_form_its_figures_stand_beside_the_entries() -> None:
    made = table({"ppo": (0.03, 0.0, 1)})
    assert beside_paper(made, summarise(made)) is None
    made["task"] = "salt_lake_city_paper"
    found = beside_paper(made, summarise(made))
    assert found is not None
    rows = {row.label: row.cells for row in found.rows}
    published, own = rows["DDPG"], rows["ppo"]
    assert [published[1].value, published[5].value] == pytest.approx([-1.85, 80.2]) and "human" not in rows
    assert own[0].value == pytest.approx(100.0 * paper_form(made, "ppo")[1]["ratio_of_sums"])


def test_costs_are_those_that_were_recorded(tmp_path: Path) -> None:
    for name, more in (("new", {"processor_s": 1800.0}), ("old", {})):
        run = tmp_path / "train" / name / "seed0"
        run.mkdir(parents=True)
        write_config(run, TrainConfig())
        for k in (1, 2):
            row = {"frames": 40 * k, "seconds": 9.0, "episodes": 18 * k, "decisions": 7, **more}
            MetricsTable(run / "metrics.csv", 40 * k - 1).append(row)
        MetricsTable(run / "validation.csv").append({"frames": 40, "co2_saved": 1.5, "delay_change_s": -2.0})
    hours = f"{36 * TrainConfig().env.horizon_s / 3600:.0f}"
    expected = [("1", "14", hours, "1.00"), ("1", "14", hours, "-")]
    assert [row.cells for row in costs(update_learning(tmp_path)).rows] == expected
    shutil.rmtree(tmp_path / "train" / "old")  # a run that is gone is still counted, one that goes on is renewed
    run = tmp_path / "train" / "new" / "seed0"
    row = {"frames": 120, "seconds": 9.0, "episodes": 54, "decisions": 7, "processor_s": 1800.0}
    MetricsTable(run / "metrics.csv", 80).append(row)
    MetricsTable(run / "validation.csv", 40).append({"frames": 120, "co2_saved": 2.5, "delay_change_s": 0.0})
    table = update_learning(tmp_path)
    more = f"{54 * TrainConfig().env.horizon_s / 3600:.0f}"
    assert [row.cells for row in costs(table).rows] == [("1", "21", more, "1.50"), expected[1]]
    saved, _, by_core_hours, _ = draw_curves(table)
    assert [(series.name, list(series.x), list(series.y)) for series in saved.series] == [
        ("new", [7.0, 21.0], [1.5, 2.5]),
        ("old", [7.0], [1.5]),
    ]
    assert [(series.name, list(series.x)) for series in by_core_hours.series] == [("new", [0.5, 1.5])]
    assert update_learning(tmp_path).equals(table)


def test_names_of_entries_stay_what_they_are(tmp_path: Path) -> None:
    for name in ("0.5", "1", "None"):
        run = tmp_path / "train" / name / "seed0"
        run.mkdir(parents=True)
        write_config(run, TrainConfig())
        row = {"frames": 40, "seconds": 9.0, "episodes": 18, "decisions": 12345678, "processor_s": 1800.0}
        MetricsTable(run / "metrics.csv").append(row)
        MetricsTable(run / "validation.csv").append({"frames": 40, "co2_saved": 1.5, "delay_change_s": -2.0})
    update_learning(tmp_path)
    table = update_learning(tmp_path)
    assert table["entry"].tolist() == ["0.5", "1", "None"]
    shutil.rmtree(tmp_path / "train")
    table = update_learning(tmp_path)
    assert [(row.label, row.cells[1]) for row in costs(table).rows] == [
        (name, "12,345,678") for name in ("0.5", "1", "None")
    ]
    charts = draw_curves(table, {"eta": {"0.5": {}, "1": {}}})
    assert [chart.name for chart in charts] == ["co2_saved", "delay_change_s"]
    assert len({series.colour for series in charts[0].series}) == 3
