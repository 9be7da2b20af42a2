"""The independent checker of certificates: exact and ball arithmetic, no prover, no CasADi.

It makes the statement of every claim itself out of the model that the certificate holds, and decides it by evaluation
with the witness beside it. A wrong certificate is not believed, however it came about.

    model    the model's text
    system   the model as exact functions, at x* in balls, and its closed loop
    claims   what each claim says, and how it is shown
    files    certificates and packages
"""
