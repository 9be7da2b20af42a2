"""The independent checker of certificates: exact and ball arithmetic, no prover, no CasADi.

It makes the statement of every claim itself out of the model that the certificate holds, and decides it by evaluation
with the witness beside it. A wrong certificate is not believed, however it came about.

    assumptions   what the claims say up to the limits of the inputs, and how they are shown
    stability     the same for the claims of stability
    claims        the verdict on every claim
    files         certificates and packages
"""
