"""Experiments: what is compared, run so that it can go on after any interruption, and put into tables."""

from evnlos.experiment.carry_over import CarriedOver, carried_table, carry_over, write_carried
from evnlos.experiment.conditions import (
    Condition,
    Finding,
    base_simulation,
    conditions,
    conditions_table,
    map_conditions,
)
from evnlos.experiment.presets import SEQUENCE, STUDIES, on_sequences
from evnlos.experiment.records import read_records, write_record
from evnlos.experiment.run import captures_of, run_study
from evnlos.experiment.simulated import Simulated, run_simulated
from evnlos.experiment.study import Arm, Place, Record, Study
from evnlos.experiment.table import (
    character_table,
    checks_table,
    difference,
    gain_table,
    means_of,
    summary_table,
)

__all__ = [
    "SEQUENCE",
    "STUDIES",
    "Arm",
    "CarriedOver",
    "Condition",
    "Finding",
    "Place",
    "Record",
    "Simulated",
    "Study",
    "base_simulation",
    "captures_of",
    "carried_table",
    "carry_over",
    "character_table",
    "checks_table",
    "conditions",
    "conditions_table",
    "difference",
    "gain_table",
    "map_conditions",
    "means_of",
    "on_sequences",
    "read_records",
    "run_simulated",
    "run_study",
    "summary_table",
    "write_carried",
    "write_record",
]
