"""Design tasks: find the parameters of a scenario that reach a goal.

A task gives a scenario, free parameters with bounds and a goal. An entry hands in
parameters; the judge simulates them with the bit-exact solver and measures what they
reach. So nobody has to trust anybody, and nothing has to be hidden.
"""

from .judge import Entry, Judgement, judge, read_entry
from .tasks import FAMILIES, Parameter, Task, load_task, task_names

__all__ = [
    "FAMILIES",
    "Entry",
    "Judgement",
    "Parameter",
    "Task",
    "judge",
    "load_task",
    "read_entry",
    "task_names",
]
