"""Design tasks: find the parameters of a scenario that reach a goal.

A task gives a scenario, free parameters with bounds and a goal. An entry hands in
parameters; the judge simulates them with the bit-exact solver and measures what they
reach. So nobody has to trust anybody, and nothing has to be hidden.
"""

from .judge import DesignEntry, Verdict, judge, read_entry, scale_error
from .tasks import FAMILIES, DesignTask, FreeParameter, load_task, task_names

__all__ = [
    "FAMILIES",
    "DesignEntry",
    "Verdict",
    "FreeParameter",
    "DesignTask",
    "judge",
    "load_task",
    "read_entry",
    "scale_error",
    "task_names",
]
