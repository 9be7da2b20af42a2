/*
 * pera_example.c: how to call the controller. This file is yours: copy it and put your drivers in.
 *
 * It needs no operating system. Here the measurements are constants and the outputs go nowhere.
 */
#include "pera.h"

#ifndef ARDUINO /* there the sketch is the program */

/* Reads the sensors, in the units of pera.h. */
static void read_sensors(pera_input_t *input)
{
    input->q1 = 0.0f;
    input->q2 = 0.0f;
    input->q3 = 0.0f;
}

/* Drives the actuators with values that lie in their bounds. Returns a sum, so that no value is optimised away. */
static float drive_actuators(const pera_output_t *output)
{
    return output->u1 + output->u2 + output->u3;
}

int main(void)
{
    pera_state_t controller;
    pera_input_t input;
    pera_output_t output;
    pera_status_t worst = PERA_OK;
    volatile float sink = 0.0f;

    pera_init(&controller);

    /* On your target: for ever, once every PERA_SAMPLE_PERIOD seconds, from a timer. */
    for (int step = 0; step < 1000; ++step)
    {
        pera_status_t status;

        read_sensors(&input);
        status = pera_step(&controller, &input, &output);
        sink = drive_actuators(&output);
        worst = (status > worst) ? status : worst;
    }
    (void)sink;
    return (int)worst;
}

#else
typedef int pera_example_is_empty;
#endif
