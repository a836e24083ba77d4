"""The paper's algorithm in torch: equations (5) to (7) by automatic differentiation, in batches.

It runs the paper's policies with Adam, open-loop inputs, plans in numpy and networks of a user's
own, many trials of one configuration at a time (:func:`dopt.spec.compatibility.check_reference`).
Everything else runs in :mod:`dopt.kernel` alone.
"""
