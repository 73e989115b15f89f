"""What all verbs of the command line share: console, options, failures, and the record of a run."""
