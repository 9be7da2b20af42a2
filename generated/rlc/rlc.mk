# For your own Makefile: include rlc.mk, compile $(RLC_SOURCES) with $(RLC_CFLAGS), link $(RLC_LIBS).
RLC_DIRECTORY := $(dir $(lastword $(MAKEFILE_LIST)))
RLC_SOURCES := $(RLC_DIRECTORY)rlc.c
RLC_CFLAGS := -I$(RLC_DIRECTORY)
RLC_LIBS := -lm
