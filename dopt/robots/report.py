"""Report of a motion: which parameters it identifies, how well, and which no motion can."""

from __future__ import annotations

import math
from typing import Any, Self

import numpy as np

from dopt.arguments import whole
from dopt.robots.design import REFERENCES, Candidate, Design, Problem, multisine
from dopt.robots.parameters import Identifiability

SHOWN = 20
"""Rows of a list that are printed; the dictionary has all."""

TOLD = 1.0 / math.sqrt(2.0)
"""Relative standard error below which a motion says more of a parameter than its prior."""


class Report(dict[str, Any]):
    """A dictionary that JSON can hold, and that prints as text.

    ``joints``, ``notes``, ``seconds``; ``null`` and ``weak``
    (:class:`~dopt.robots.parameters.Identifiability`); ``parameters``, each with its name, unit,
    nominal value and the half-width of its expected 95 % interval. The report of a design also has
    ``best``, ``candidates``, the ``gap`` of the bound of information, and the largest shares of the
    ``limits`` that the best motion takes.
    """

    @classmethod
    def check(cls, problem: Problem, seed: int = 0) -> Self:
        """Report which parameters the best of some random multisines identifies, and how well."""
        best = multisine(problem, np.random.default_rng(whole("seed", seed, 0, 2**63)))
        report = cls._expecting(problem, best)
        if obstacle := problem.obstacle(best):
            report["notes"].append(f"the best multisine breaks limits: {obstacle}")
        return report

    @classmethod
    def of(cls, design: Design) -> Self:
        """Report the candidates of a design, and what the best one identifies."""
        problem, best = design.problem, design.best
        report = cls._expecting(problem, best)
        motion = best.motion(1.0 / problem.rate)
        strain = float(problem.strains(motion).max())
        report["best"], report["gap"] = best.name, design.gap
        report["candidates"] = [
            {
                "name": one.name,
                "share": one.share,
                "error_by_reference": math.exp(float(np.log(one.errors / design.reference).mean())),
                "worst_by_reference": float((one.errors / design.reference).max()),
                "within_limits": one.free,
            }
            for one in design.candidates
        ]
        report["limits"] = problem.limits.shares(motion) | {"torque": strain}
        return report

    @classmethod
    def _expecting(cls, problem: Problem, one: Candidate) -> Self:
        found = Identifiability.of(problem.unknowns, one.motion(problem.step), problem.rate)
        return cls(
            joints=list(problem.body.joints),
            notes=[*problem.body.notes, *problem.limits.notes],
            motions=REFERENCES,
            seconds=problem.seconds,
            null=found.null,
            weak=found.weak,
            parameters=[
                {
                    "name": parameter.name,
                    "unit": parameter.unit,
                    "nominal": parameter.value,
                    "half_width": 1.96 * float(error) * parameter.scale,
                    "relative": 1.96 * float(error),
                }
                for parameter, error in zip(problem.requested, one.errors, strict=True)
            ],
        )

    def __str__(self) -> str:
        lines = [f"note: {note}" for note in self["notes"]]
        lines.append(
            "units: rad and N m of hinges, m and N of slides, at the joint, behind its gear; the "
            "parameter gear is a joint's torque by the commanded one"
        )
        lines += _listed(
            self["null"],
            "combination{} of parameters that no motion can identify",
            "every combination of the parameters changes the torques",
        )
        lines += _listed(
            self["weak"],
            "parameter{} with a standard error above 100 %",
            "no parameter with a standard error above 100 %",
        )
        by = f"the best of {self['motions']} random multisines of"
        if "best" in self:
            by = f"{self['best']},"
            lines += self._compared()
        return "\n".join([*lines, *self._expected(by)])

    def _compared(self) -> list[str]:
        lines = [f"{'motion':<20} {'information':>12} {'errors':>8} {'worst':>8}"]
        for row in self["candidates"]:
            kept = "" if row["within_limits"] else "  breaks limits"
            lines.append(
                f"{row['name']:<20} {100.0 * row['share']:>10.1f} % "
                f"{row['error_by_reference']:>8.2f} {row['worst_by_reference']:>8.2f}{kept}"
            )
        parts = [f"{kind} {100.0 * share:.0f} %" for kind, share in self["limits"].items()]
        return [
            *lines,
            "information: share of the attainable one for each parameter; errors and worst: "
            "standard errors by the median of random multisines, their geometric mean and the "
            "largest",
            f"of the limits, {self['best']} takes: {', '.join(parts)}; no bodies touch",
        ]

    def _expected(self, by: str) -> list[str]:
        """Return the expected intervals, the least certain first."""
        rows = sorted(self["parameters"], key=lambda row: -row["relative"])
        known = [row for row in rows if row["relative"] < 1.96 * TOLD]
        lines = [
            f"expected half-widths of 95 % intervals by {by} {self['seconds']:g} s, with a prior "
            f"of 100 % on each parameter, of a typical size where it is 0:"
        ]
        for row in known[:SHOWN]:
            percent = f"{100.0 * row['relative']:.3g} %"
            lines.append(
                f"  {row['name']:<40} {row['nominal']:>10.4g} ± {row['half_width']:<9.3g} "
                f"{row['unit']:<12} {percent}"
            )
        if len(known) > SHOWN:
            lines.append(f"  and {len(known) - SHOWN} that are better (--json)")
        if len(known) < len(rows):
            lines.append(f"  and {len(rows) - len(known)} of which this says little or nothing")
        return lines


def _listed(items: list[str], what: str, without: str) -> list[str]:
    """Return the first of some items below their number, or a sentence where there are no items."""
    if not items:
        return [without]
    more = [f"  and {len(items) - SHOWN} more (--json)"] if len(items) > SHOWN else []
    head = f"{len(items)} {what.format('s' * (len(items) > 1))}:"
    return [head, *(f"  {item}" for item in items[:SHOWN]), *more]
