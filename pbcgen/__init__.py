"""pbcgen: from a CasADi model of a physical system to a proved, saturated controller in C."""

__version__ = "0.1.0"
