/*
 * coupling_device_example.c: how to call the controller. This file is yours: copy it and put your drivers in.
 *
 * It needs no operating system. Here the measurements are constants and the outputs go nowhere.
 */
#include "coupling_device.h"

#ifndef ARDUINO /* there the sketch is the program */

/* Reads the sensors, in the units of coupling_device.h. */
static void read_sensors(coupling_device_input_t *input)
{
    input->x1 = 0.0f;
    input->x2 = 0.0f;
    input->x3 = 0.0f;
}

/* Drives the actuators with values that lie in their bounds. Returns a sum, so that no value is optimised away. */
static float drive_actuators(const coupling_device_output_t *output)
{
    return output->u;
}

int main(void)
{
    coupling_device_state_t controller;
    coupling_device_input_t input;
    coupling_device_output_t output;
    coupling_device_status_t worst = COUPLING_DEVICE_OK;
    volatile float sink = 0.0f;

    coupling_device_init(&controller);

    /* On your target: for ever, once every COUPLING_DEVICE_SAMPLE_PERIOD seconds, from a timer. */
    for (int step = 0; step < 1000; ++step)
    {
        coupling_device_status_t status;

        read_sensors(&input);
        status = coupling_device_step(&controller, &input, &output);
        sink = drive_actuators(&output);
        worst = (status > worst) ? status : worst;
    }
    (void)sink;
    return (int)worst;
}

#else
typedef int coupling_device_example_is_empty;
#endif
