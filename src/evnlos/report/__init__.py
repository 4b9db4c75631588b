"""Results for people: one HTML page with its numbers as CSV, and reconstructions as images."""

from evnlos.report.page import write_report
from evnlos.report.pictures import reconstruct_capture, result_sheet
from evnlos.report.provenance import lab_command
from evnlos.report.tables import RunResult, collect_results, refuse_seen, seen_in_training, to_csv, to_text

__all__ = [
    "RunResult",
    "collect_results",
    "lab_command",
    "reconstruct_capture",
    "refuse_seen",
    "result_sheet",
    "seen_in_training",
    "to_csv",
    "to_text",
    "write_report",
]
