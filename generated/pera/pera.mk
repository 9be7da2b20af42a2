# For your own Makefile: include pera.mk, compile $(PERA_SOURCES) with $(PERA_CFLAGS), link $(PERA_LIBS).
PERA_DIRECTORY := $(dir $(lastword $(MAKEFILE_LIST)))
PERA_SOURCES := $(PERA_DIRECTORY)pera.c
PERA_CFLAGS := -I$(PERA_DIRECTORY)
PERA_LIBS := -lm
