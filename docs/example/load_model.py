"""Read a model that ``dopt.fit(...).save("model.npz")`` has written; NumPy is all it needs."""

import numpy as np

FUNCTIONS = {"sin": np.sin, "cos": np.cos, "tanh": np.tanh, "sign": np.sign}
FUNCTIONS |= {"magnitude": np.abs, "where": np.where, "__builtins__": {}}


def load(path):
    """Return derivative(x, u) and step(x, u, seconds), u the input that acts."""
    m = np.load(path)
    codes = [compile(text, "known", "eval") for text in m["known"].tolist()]
    constants = dict(zip(m["constant_names"].tolist(), m["constants"], strict=True))
    names = [*m["states"].tolist(), *m["inputs"].tolist()]
    kinds, at = m["feature_kinds"], m["feature_indices"]

    def derivative(x, u):
        given = {**FUNCTIONS, **constants, **dict(zip(names, [*x, *u], strict=True))}
        flow = np.array([eval(code, given) for code in codes], float)
        phi = (x[at] - m["feature_centers"]) / m["feature_scales"]
        phi = np.where(kinds == 1, np.cos(x[at]), np.where(kinds == 2, np.sin(x[at]), phi))
        flow[m["learned"]] += m["sizes"] * (m["W2"] @ np.tanh(m["W1"] @ phi + m["b1"]) + m["b2"])
        return flow

    def step(x, u, seconds):
        k1 = derivative(x, u)
        k2 = derivative(x + seconds / 2 * k1, u)
        k3 = derivative(x + seconds / 2 * k2, u)
        k4 = derivative(x + seconds * k3, u)
        return x + seconds / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    return derivative, step
