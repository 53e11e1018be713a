"""The program's own sections of a report, one file each; in the order of the page in `workflows.report.section`."""
