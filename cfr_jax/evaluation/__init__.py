"""Methods side by side on the same pairs: run, measured, tabulated, drawn.

Every method runs in a process of its own, which may crash or hang without harm to the rest.
"""
