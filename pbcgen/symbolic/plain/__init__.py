"""A second reading of formulas, which shares nothing with the first: for checking what was proved.

Tapes as lines of text, exact functions, balls, derivatives and matrices, with the standard library and python-flint
only. CasADi is not needed.

    values     numbers, exact functions, derivatives
    formulas   numbered instructions and their outputs
    matrices   products, definiteness
    spectra    zeros of functions, eigenvalues
"""
