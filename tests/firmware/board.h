/* What the test program asks of the board. */
#ifndef BOARD_H
#define BOARD_H

#include <stdint.h>

void board_write(const char *text);
void board_exit(int code);
void board_start_counter(void);
uint32_t board_counter(void); /* counts up; wraps after 24 bits */

#endif
