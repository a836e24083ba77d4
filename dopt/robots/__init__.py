"""Robots whose rigid body is known: which motion identifies what is not, planned or online."""

from dopt.robots.body import Body, Motion
from dopt.robots.design import Design, Problem
from dopt.robots.explorer import RobotExplorer
from dopt.robots.limits import Limits
from dopt.robots.report import Report
from dopt.robots.sysid import sequences

__all__ = ["Body", "Design", "Limits", "Motion", "Problem", "Report", "RobotExplorer", "sequences"]
