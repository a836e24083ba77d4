"""Hydra plugin: a sweeper that expands a grid by composing each choice of groups once.

Hydra finds it because ``orchestrate/`` is on the module path of a launch. Modules whose name starts
with an underscore are skipped by Hydra's plugin scan, which executes every other one twice.
"""
