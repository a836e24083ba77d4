"""Dense oracles of the kernel: plain numpy that follows the definitions and shares no code with it.

An oracle says what a step should give, from what stood there before it. It evaluates a model by
:meth:`dopt.models.Model.predict_at`, and takes Jacobians by a complex step.
"""
