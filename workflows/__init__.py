"""Studies: configuration, the run, results, report and the command line."""

from workflows import catalogue as catalogue  # words of findings, wherever one is made
