"""All faulty files, by name: what makes them, and the check that names them."""

import faults_of_files
import faults_of_format
import faults_of_task
import faults_of_values
from fault_registry import FAULTS

__all__ = [
    "FAULTS",
    "faults_of_files",
    "faults_of_format",
    "faults_of_task",
    "faults_of_values",
]
