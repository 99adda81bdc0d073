"""Every command, in the order in which a user meets them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class CommandEntry:
    """A command as its group lists it, without its code."""

    name: str
    # "module:function", the module below lagbench.cli
    target: str
    # line of the group's help; the docstring of the function begins with it too
    summary: str
    # words of a call that the help of the command shows, without "lagbench"
    example: str


COMMANDS = (
    CommandEntry(
        name="demo",
        target="demo:demo_command",
        summary="Make data sets, train a model, score it and draw a leaderboard page.",
        example="demo --root demo",
    ),
    CommandEntry(
        name="list",
        target="inventory:list_command",
        summary="List all splits and sizes, their cost, and the data on this machine.",
        example="list cavity",
    ),
    CommandEntry(
        name="info",
        target="inventory:info_command",
        summary="Show the parameters, sizes, cost and local data of a split.",
        example="info cavity --size mini",
    ),
    CommandEntry(
        name="generate",
        target="generate:generate_command",
        summary="Simulate a split and write its files.",
        example="generate --split cavity --size tiny --workers 2",
    ),
    CommandEntry(
        name="verify",
        target="verify:verify_command",
        summary="Hash the files of a split and compare them with the recorded hashes.",
        example="verify --split cavity --size tiny --regenerate 2",
    ),
    CommandEntry(
        name="download",
        target="download:download_command",
        summary="Download a split and check its content; simulate missing scenarios.",
        example="download --split cavity --size mini --from https://host/data",
    ),
    CommandEntry(
        name="export",
        target="export:export_command",
        summary="Write a split in the file format of another code base.",
        example="export cavity --size mini --format gns-npz -o cavity-gns",
    ),
    CommandEntry(
        name="import",
        target="local_splits:import_command",
        summary="Make a local split from the data of another code base.",
        example="import WaterDrop --format gns-npz -o drop",
    ),
    CommandEntry(
        name="adopt",
        target="local_splits:adopt_command",
        summary="Make a local split from your own trajectories.",
        example="adopt runs/*.npz -o own --radius 0.03 --frame-interval 0.1",
    ),
    CommandEntry(
        name="template",
        target="template:template_command",
        summary="Write a valid predictions.nc for you to fill in; in it nothing moves.",
        example="template cavity --size tiny -o predictions.nc",
    ),
    CommandEntry(
        name="validate",
        target="validate:validate_command",
        summary="Check a predictions.nc; print every error and how to fix it.",
        example="validate predictions.nc",
    ),
    CommandEntry(
        name="score",
        target="score:score_command",
        summary="Score a predictions.nc; write scores.json and scores.nc.",
        example="score predictions.nc",
    ),
    CommandEntry(
        name="compare",
        target="compare:compare_command",
        summary="Compare two methods with statistical tests and confidence intervals.",
        example="compare ours/scores.json theirs/scores.json",
    ),
    CommandEntry(
        name="train",
        target="train:train_command",
        summary="Train a reference model.",
        example="train --baseline gns --split cavity --size tiny",
    ),
    CommandEntry(
        name="predict",
        target="predict:predict_command",
        summary="Predict the test scenarios with a trained model.",
        example="predict runs/cavity/tiny/gns-0/weights.safetensors",
    ),
    CommandEntry(
        name="bench",
        target="bench:bench_command",
        summary="Measure how long our solver takes for a frame on this machine.",
        example="bench solver --split cavity --size tiny",
    ),
    CommandEntry(
        name="submit",
        target="submit:submit_command",
        summary="Score predictions and add them to a leaderboard as an entry.",
        example="submit predictions.nc --from meta.yaml",
    ),
    CommandEntry(
        name="plot",
        target="pictures:plot_command",
        summary="Draw one frame of a scenario: particles, vorticity, streamlines.",
        example="plot cavity --size tiny --scenario 3 --frame 15 -o flow.png",
    ),
    CommandEntry(
        name="animate",
        target="pictures:animate_command",
        summary="Make an MP4 or GIF film of a scenario, or of two side by side.",
        example="animate fluid --size tiny --scenario 3 -o splash.gif",
    ),
    CommandEntry(
        name="cite",
        target="cite:cite_command",
        summary="Print how to cite a split: version, hashes and original works.",
        example="cite cavity",
    ),
    CommandEntry(
        name="doctor",
        target="doctor:doctor_command",
        summary="Check this machine: libraries, cores, disk, registry.",
        example="doctor",
    ),
    CommandEntry(
        name="clean",
        target="clean:clean_command",
        summary="Remove one data set, or only its temporary files.",
        example="clean --split cavity --size tiny --dry-run",
    ),
)

LEADERBOARD_COMMANDS = (
    CommandEntry(
        name="build",
        target="leaderboard:build_command",
        summary="Draw the leaderboard's page: one self-contained index.html.",
        example="leaderboard build",
    ),
    CommandEntry(
        name="check",
        target="leaderboard:check_command",
        summary="Check all entries, score files and aggregates of the leaderboard.",
        example="leaderboard check --base origin/main",
    ),
    CommandEntry(
        name="picture",
        target="leaderboard:picture_command",
        summary="Draw the accuracy of models against their cost as an SVG file.",
        example="leaderboard picture cavity --size mini -o cost.svg",
    ),
    CommandEntry(
        name="reproduce",
        target="leaderboard:reproduce_command",
        summary="Run the models of entries again, compare scores, measure costs.",
        example="leaderboard reproduce cavity/mini/gns --scenarios 2",
    ),
    CommandEntry(
        name="shift",
        target="leaderboard:shift_command",
        summary="Score models of entries on shift, scenarios unlike those of train.",
        example="leaderboard shift cavity/mini/gns",
    ),
    CommandEntry(
        name="show",
        target="leaderboard:show_command",
        summary="Print the tables of the leaderboard.",
        example="leaderboard show cavity --size mini",
    ),
)
