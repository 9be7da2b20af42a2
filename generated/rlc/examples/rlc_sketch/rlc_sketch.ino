// The controller in an Arduino sketch: one step each sample period. Put your sensors and actuators in.
#include <rlc.h>

static rlc_state_t controller;
static unsigned long last_step;

void setup()
{
    rlc_init(&controller);
    last_step = micros();
}

void loop()
{
    const unsigned long period = (unsigned long)(1e6f * (float)RLC_SAMPLE_PERIOD + 0.5f);
    rlc_input_t input;
    rlc_output_t output;

    if (micros() - last_step < period)
    {
        return;
    }
    last_step += period;
    input.x3 = 0.0f; // read the sensor, V
    (void)rlc_step(&controller, &input, &output);
    (void)output.u; // drive the actuator, V
}
