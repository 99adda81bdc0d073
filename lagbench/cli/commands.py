"""Every command, in the order in which a user meets them."""

from __future__ import annotations

from typing import NamedTuple


class Command(NamedTuple):
    """A command as the help lists it, without its code."""

    # heading of the help under which it stands
    group: str
    # words behind "lagbench"
    name: str
    # "module:function", the module below lagbench.cli
    target: str
    summary: str
    # words of a call that the help of the command shows, without "lagbench"
    example: str


# first word, heading of the help, summary
COMMAND_GROUPS = (
    ("leaderboard", "Leaderboard", "Draw, check and show the leaderboard."),
    ("design", "Design", "Search for parameters, judged by the simulator."),
)

COMMANDS = (
    Command(
        "Begin",
        "demo",
        "demo:demo_command",
        "Make data sets, train a model, score it and draw a leaderboard page.",
        "demo --root demo",
    ),
    Command(
        "Begin",
        "doctor",
        "doctor:doctor_command",
        "Check this machine: libraries, cores, disk, registry.",
        "doctor",
    ),
    Command(
        "Data",
        "list",
        "inventory:list_command",
        "List all splits and sizes, their cost, and the data on this machine.",
        "list",
    ),
    Command(
        "Data",
        "info",
        "inventory:info_command",
        "Show the task, sizes, parameters and local data of a split.",
        "info cavity --size mini",
    ),
    Command(
        "Data",
        "generate",
        "generate:generate_command",
        "Simulate a split; an interrupted call goes on where it stopped.",
        "generate --split cavity --size tiny --workers 2",
    ),
    Command(
        "Data",
        "download",
        "download:download_command",
        "Download a split and check its content; simulate missing scenarios.",
        "download --split cavity --size mini --from https://host/data",
    ),
    Command(
        "Data",
        "verify",
        "verify:verify_command",
        "Hash the files of a split and compare them with the recorded hashes.",
        "verify --split cavity --size tiny --regenerate 2",
    ),
    Command(
        "Data",
        "cite",
        "cite:cite_command",
        "Print how to cite a split, as an entry of BibTeX.",
        "cite cavity",
    ),
    Command(
        "Other people's data",
        "import",
        "local_splits:import_command",
        "Make a local split from data of other programs or code bases.",
        "import runs/*.npz -o own --frame-interval 0.1",
    ),
    Command(
        "Other people's data",
        "adopt",
        "local_splits:import_command",
        "The same as import.",
        "adopt runs/*.npz -o own --frame-interval 0.1",
    ),
    Command(
        "Other people's data",
        "export",
        "export:export_command",
        "Write a split in the file format of another code base.",
        "export cavity --size mini --format gns-npz -o cavity-gns",
    ),
    Command(
        "Models",
        "train",
        "train:train_command",
        "Train a reference model; an interrupted call goes on where it stopped.",
        "train --baseline gns --split cavity --size tiny",
    ),
    Command(
        "Models",
        "predict",
        "predict:predict_command",
        "Predict the test scenarios with a trained model.",
        "predict runs/cavity/tiny/gns-0/weights.safetensors",
    ),
    Command(
        "Models",
        "bench",
        "bench:bench_command",
        "Measure how long our solver takes for a frame on this machine.",
        "bench --split cavity --size tiny",
    ),
    Command(
        "Scores",
        "template",
        "template:template_command",
        "Write a valid predictions.nc for you to fill in; in it nothing moves.",
        "template cavity --size tiny -o predictions.nc",
    ),
    Command(
        "Scores",
        "validate",
        "validate:validate_command",
        "Check a predictions.nc; print every error and how to fix it.",
        "validate predictions.nc",
    ),
    Command(
        "Scores",
        "score",
        "score:score_command",
        "Score a predictions.nc; write scores.json and scores.nc.",
        "score predictions.nc",
    ),
    Command(
        "Scores",
        "compare",
        "compare:compare_command",
        "Compare two methods with statistical tests and confidence intervals.",
        "compare ours/scores.json theirs/scores.json",
    ),
    Command(
        "Pictures",
        "plot",
        "pictures:plot_command",
        "Draw one frame of a scenario: particles, vorticity, streamlines.",
        "plot cavity --size tiny --scenario 3 --frame 15 -o flow.png",
    ),
    Command(
        "Pictures",
        "animate",
        "pictures:animate_command",
        "Make an MP4 or GIF film of a scenario, or of two side by side.",
        "animate fluid --size tiny --scenario 3 -o splash.gif",
    ),
    Command(
        "Pictures",
        "view",
        "pictures:view_command",
        "Show a scenario, and a prediction beside it, in Rerun's viewer.",
        "view fluid predictions.nc --size tiny",
    ),
    Command(
        "Leaderboard",
        "submit",
        "submit:submit_command",
        "Score predictions and add them to a leaderboard as an entry.",
        "submit predictions.nc --from meta.yaml",
    ),
    Command(
        "Leaderboard",
        "leaderboard build",
        "leaderboard:build_command",
        "Draw the leaderboard's page: one self-contained index.html.",
        "leaderboard build",
    ),
    Command(
        "Leaderboard",
        "leaderboard check",
        "leaderboard:check_command",
        "Check all entries, score files and weights of the leaderboard.",
        "leaderboard check",
    ),
    Command(
        "Leaderboard",
        "leaderboard picture",
        "leaderboard:picture_command",
        "Draw error against cost as a file: a small panel for each data set.",
        "leaderboard picture --size mini -o front.svg",
    ),
    Command(
        "Leaderboard",
        "leaderboard reproduce",
        "leaderboard:reproduce_command",
        "Run the models of entries again, compare scores, measure costs.",
        "leaderboard reproduce cavity/mini/gns --scenarios 2",
    ),
    Command(
        "Leaderboard",
        "leaderboard shift",
        "leaderboard:shift_command",
        "Score models of entries on shift, scenarios unlike those of train.",
        "leaderboard shift cavity/mini/gns",
    ),
    Command(
        "Leaderboard",
        "leaderboard show",
        "leaderboard:show_command",
        "Print the tables of the leaderboard.",
        "leaderboard show cavity --size mini",
    ),
    Command(
        "Design",
        "design list",
        "design:list_command",
        "List all design tasks.",
        "design list",
    ),
    Command(
        "Design",
        "design info",
        "design:info_command",
        "Show the goal of a task, and its parameters with their bounds.",
        "design info pour-03",
    ),
    Command(
        "Design",
        "design judge",
        "design:judge_command",
        "Simulate the parameters of an entry and measure what they reach.",
        "design judge entry.json --workers 2",
    ),
)
