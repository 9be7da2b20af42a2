/*
 * The error of the fast tanh of a generated package over every float. Compile it with the package, for instance
 *
 *     cc -O2 -ffp-contract=off -DPACKAGE='"coupling_device.c"' -DTANH=coupling_device_tanh \
 *        -I generated/coupling_device benchmarks/hyperbolic_bound.c -lm -o bound && ./bound
 *
 * It takes about a minute. With -ffp-contract=fast -mfma it measures the contracted form. With -DLIBM and TANH the tanh
 * of a package with `--tanh libm` it measures the math library, of which less is asked.
 */
#include PACKAGE

#ifdef LIBM
#define TINY 1e-37f /* below, floats are denormal */
#define IS_WRONG_AT_TINY(x, t) 0
#else
#define TINY 1e-5f
#define IS_WRONG_AT_TINY(x, t) (((x) < TINY) && ((t) != (x)))
#endif

#ifndef OUTSIDE
#define OUTSIDE 1u /* only every so many floats where tanh(x) is x or 1 */
#endif

#include <stdint.h>
#include <stdio.h>
#include <string.h>

int main(void)
{
    double ulps = 0.0;
    double absolute = 0.0;
    double drop = 0.0;
    float previous = 0.0f;

    for (uint32_t bits = 0u; bits < 0x7f800000u; bits += ((previous > 1e-5f) && (previous < 1.0f)) ? 1u : OUTSIDE)
    {
        float x;
        float t;

        memcpy(&x, &bits, sizeof x);
        t = TANH(x);
        if (!(t >= 0.0f) || !(t <= 1.0f) || ((x > 19.0f) && (t != 1.0f)) || IS_WRONG_AT_TINY(x, t))
        {
            printf("tanh(%a) = %a\n", (double)x, (double)t);
            return 1;
        }
        if ((x >= TINY) && (x <= 19.0f))
        {
            const double exact = tanh((double)x);
            const double error = fabs((double)t - exact);
            const double unit = ldexp(1.0, ilogb(exact) - 23);

            ulps = (error > ulps * unit) ? error / unit : ulps;
            absolute = (error > absolute) ? error : absolute;
        }
        drop = ((double)previous - (double)t > drop) ? (double)previous - (double)t : drop;
        previous = t;
    }
    printf("every float: %.2f ulp, %.3g absolute, largest drop %.3g\n", ulps, absolute, drop);
    return 0;
}
