"""Reproduction of the POLySIGHT paper's tables and figures by simulation, compared with the published values.

In these files "the paper" is POLySIGHT (SenSys 2026), see CITATION.cff, and so are the numbers of figures, tables and
equations. Eq. 2 are Fresnel's coefficients, Eq. 3 gives the permittivity from P = H / V relative to metal.
"""
