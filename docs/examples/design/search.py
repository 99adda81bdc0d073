"""Throw a body of liquid into a bucket: a search that hands in an entry.

python docs/examples/design/search.py --runs 50 -o entry.json
lagbench design judge entry.json
"""

import argparse
import json
import time

import numpy as np

from lagbench.design import load_task

parser = argparse.ArgumentParser()
parser.add_argument("--task", default="pour-00")
parser.add_argument("--runs", type=int, default=50)
parser.add_argument("-o", "--output", default="entry.json")
arguments = parser.parse_args()

task = load_task(arguments.task)
rng = np.random.default_rng(0)
started = time.process_time()

# Parameters are searched as shares of their ranges, from 0 to 1.
best = np.full(len(task.parameters), 0.5)
least = task.objective(task.at(best))
step = 0.3
for _ in range(arguments.runs - 1):
    shares = np.clip(best + step * rng.standard_normal(len(best)), 0.0, 1.0)
    error = task.objective(task.at(shares))  # one run of the simulator
    if error < least:
        best, least = shares, error
        step *= 1.5
    else:
        step *= 0.9

entry = {
    "method": "one parent, one child",
    "parameters": {task.name: task.at(best)},
    "seconds": {task.name: time.process_time() - started},
    "runs": {task.name: arguments.runs},
}
with open(arguments.output, "w") as file:
    json.dump(entry, file, indent=1)
