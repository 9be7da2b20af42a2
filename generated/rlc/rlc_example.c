/*
 * rlc_example.c: how to call the controller. This file is yours: copy it and put your drivers in.
 *
 * It needs no operating system. Here the measurements are constants and the outputs go nowhere.
 */
#include "rlc.h"

#ifndef ARDUINO /* there the sketch is the program */

/* Reads the sensors, in the units of rlc.h. */
static void read_sensors(rlc_input_t *input)
{
    input->x3 = 0.0f;
}

/* Drives the actuators with values that lie in their bounds. Returns a sum, so that no value is optimised away. */
static float drive_actuators(const rlc_output_t *output)
{
    return output->u;
}

int main(void)
{
    rlc_state_t controller;
    rlc_input_t input;
    rlc_output_t output;
    rlc_status_t worst = RLC_OK;
    volatile float sink = 0.0f;

    rlc_init(&controller);

    /* On your target: for ever, once every RLC_SAMPLE_PERIOD seconds, from a timer. */
    for (int step = 0; step < 1000; ++step)
    {
        rlc_status_t status;

        read_sensors(&input);
        status = rlc_step(&controller, &input, &output);
        sink = drive_actuators(&output);
        worst = (status > worst) ? status : worst;
    }
    (void)sink;
    return (int)worst;
}

#else
typedef int rlc_example_is_empty;
#endif
