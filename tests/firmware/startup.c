/* Vector table, start-up and semihosting for an emulated Cortex-M board without an operating system. */
#include "board.h"

#include <stdint.h>

extern uint32_t stack_top, data_start, data_end, data_load, bss_start, bss_end;

int main(void);
void reset_handler(void);
void fault_handler(void);

static int semihost(int operation, const void *argument)
{
    register int r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = argument;

    __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

void board_write(const char *text)
{
    (void)semihost(0x04, text);
}

void board_exit(int code)
{
    const uint32_t block[2] = { 0x20026u, (uint32_t)code }; /* ADP_Stopped_ApplicationExit */

    (void)semihost(0x20, block);
    for (;;)
    {
    }
}

void reset_handler(void)
{
    const uint32_t *source = &data_load;

#if defined(__ARM_FP)
    *(volatile uint32_t *)0xE000ED88u |= 0xFu << 20; /* CPACR: the floating-point unit */
    __asm__ volatile("dsb\n\tisb");
#endif
    for (uint32_t *target = &data_start; target < &data_end; ++target)
    {
        *target = *source++;
    }
    for (uint32_t *target = &bss_start; target < &bss_end; ++target)
    {
        *target = 0u;
    }
    board_exit(main());
}

void fault_handler(void)
{
    board_write("fault\n");
    board_exit(99);
}

__attribute__((section(".vectors"), used)) static void (*const vectors[16])(void) = {
    (void (*)(void))(uintptr_t)&stack_top, reset_handler, fault_handler, fault_handler, fault_handler,
    fault_handler, fault_handler, 0, 0, 0, 0, fault_handler, fault_handler, 0, fault_handler, fault_handler,
};

/* SysTick counts the emulator's virtual time, in which every instruction takes the same time. */
#define SYST ((volatile uint32_t *)0xE000E010u)

void board_start_counter(void)
{
    SYST[1] = 0xFFFFFFu;
    SYST[2] = 0u;
    SYST[0] = 5u;
}

uint32_t board_counter(void)
{
    return 0xFFFFFFu - SYST[2];
}
