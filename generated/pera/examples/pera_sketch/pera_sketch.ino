// The controller in an Arduino sketch: one step each sample period. Put your sensors and actuators in.
#include <pera.h>

static pera_state_t controller;
static unsigned long last_step;

void setup()
{
    pera_init(&controller);
    last_step = micros();
}

void loop()
{
    const unsigned long period = (unsigned long)(1e6f * (float)PERA_SAMPLE_PERIOD + 0.5f);
    pera_input_t input;
    pera_output_t output;

    if (micros() - last_step < period)
    {
        return;
    }
    last_step += period;
    input.q1 = 0.0f; // read the sensor, rad
    input.q2 = 0.0f; // read the sensor, rad
    input.q3 = 0.0f; // read the sensor, rad
    (void)pera_step(&controller, &input, &output);
    (void)output.u1; // drive the actuator, N m
    (void)output.u2; // drive the actuator, N m
    (void)output.u3; // drive the actuator, N m
}
