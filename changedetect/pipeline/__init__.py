"""
Steps as plain functions, and the runs that put them together.

Import from the modules: `ingest` (adding an epoch), `learn` (models), `products` (rasters), `update` (the main job),
`queries` (predicting anywhere), `verify`, `simulate`. This file imports none of them, so that the command line answers
``--help`` without loading compiled code.
"""
