// The controller in an Arduino sketch: one step each sample period. Put your sensors and actuators in.
#include <coupling_device.h>

static coupling_device_state_t controller;
static unsigned long last_step;

void setup()
{
    coupling_device_init(&controller);
    last_step = micros();
}

void loop()
{
    const unsigned long period = (unsigned long)(1e6f * (float)COUPLING_DEVICE_SAMPLE_PERIOD + 0.5f);
    coupling_device_input_t input;
    coupling_device_output_t output;

    if (micros() - last_step < period)
    {
        return;
    }
    last_step += period;
    input.x1 = 0.0f; // read the sensor, C
    input.x2 = 0.0f; // read the sensor, m
    input.x3 = 0.0f; // read the sensor, m
    (void)coupling_device_step(&controller, &input, &output);
    (void)output.u; // drive the actuator, V
}
