"""Command line: results on standard output, progress on standard error, exit codes for scripts.

The sections below are the help of options that several commands share, by panel.

Arguments
---------
files : FILE...
    Measured files; several files are several runs.
store : STORE
    Checkpoint file, written with --store.
model : MODEL
    Saved model.

File
----
separator
    Separator of cells; default detected.
decimal
    Decimal mark; default detected.
thousands
    Mark between groups of thousands; default detected.
skip : LINES
    Lines above the table; default detected.
header : 0|1|2
    Header lines: none, names, names and units; default detected.
sheet
    Sheet of a workbook.

Structure
---------
structure
    flexible-link:STAGE, arm:STAGE (1, 2, both) or an equation.
fixed : NAME=VALUE
    Fix a coefficient.
delay : INPUT=SECONDS
    Delay of an input [s]; LOW:HIGH estimates it in this range.
driven_by : OUTPUT=SIGNAL,…
    With auto: input signals of an output; default all inputs.

Method
------
m
    Block pulses per run; default 2048, fewer for short runs.
threads
    Number of threads; default FTLM_THREADS, or all cores.
bounds : NAME=LOW:HIGH
    Bounds of a parameter; inf for an open side.
loss
    Loss function; huber is robust to outliers; default squares.

Output
------
force
    Overwrite existing files.
as_json
    Print the result as JSON.
validation_window : FROM:TO
    Part of the validation run, in seconds [s]; default all of it.
out : FILE
    Write the model to this .json file.
page : HTML
    Write the page to this file.
report : HTML
    Write an HTML report to this file.
verbose
    Print all details and all warnings.

Options
-------
noise : OUTPUT=A
    Noise standard deviation of an output; default from the fit.
increment
    Increment of the order grid.
"""

from ftlm.cli.main import app, main

__all__ = ["app", "main"]
