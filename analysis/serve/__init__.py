"""The results browser: pages over the database, read-only, on this machine alone.

``app`` puts the parts together: ``guard`` refuses what no page sends, ``source`` opens the
database, ``asked`` reads a request, one module for each page makes its numbers, and ``answers``
turns these into a page or into JSON. The numbers come from the functions that feed the figures.
"""
