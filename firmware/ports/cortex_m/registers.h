/* Registers and instructions: the Cortex-M core's, the same on every chip, and the board's, which are not.
 * The board is Arm's MPS2 (AN385 with a Cortex-M3, AN386 with a Cortex-M4F), which QEMU emulates. */
#ifndef PORTS_CORTEX_M_REGISTERS_H
#define PORTS_CORTEX_M_REGISTERS_H

#include <stdint.h>

#define REGISTER(address) (*(volatile uint32_t *)(address))

/* --- the core --- */

#define SYSTICK_CONTROL REGISTER(0xE000E010u)
#define SYSTICK_RELOAD REGISTER(0xE000E014u)
#define SYSTICK_VALUE REGISTER(0xE000E018u) /* counts down; any write clears it */
#define SYSTICK_CONTROL_RUN 7u              /* enable, interrupt, processor clock */

#define NVIC_ENABLE REGISTER(0xE000E100u)  /* a bit per interrupt 0..31 */
#define NVIC_PENDING REGISTER(0xE000E200u) /* writing a bit makes that interrupt pending */

#define INTERRUPT_STATE REGISTER(0xE000ED04u)
#define INTERRUPT_STATE_SYSTICK_PENDING (1u << 26)

#define COPROCESSOR_ACCESS REGISTER(0xE000ED88u)
#define COPROCESSOR_ACCESS_FPU (0xFu << 20)

static inline void interrupts_disable(void)
{
    __asm__ volatile("cpsid i" ::: "memory");
}

static inline void interrupts_enable(void)
{
    __asm__ volatile("cpsie i" ::: "memory");
}

/* Sleep until an interrupt is pending, whether or not interrupts are enabled. */
static inline void wait_for_interrupt(void)
{
    __asm__ volatile("dsb\n\twfi" ::: "memory");
}

static inline uint32_t *stack_pointer(void)
{
    uint32_t *pointer;
    __asm__ volatile("mov %0, sp" : "=r"(pointer));
    return pointer;
}

static inline void barrier(void)
{
    __asm__ volatile("dsb\n\tisb" ::: "memory");
}

/* --- the board --- */

#define CLOCK_MHZ 25u /* of the processor, SysTick and the UART */

/* UART 0 is a CMSDK APB UART. */
#define UART_DATA REGISTER(0x40004000u)
#define UART_STATE REGISTER(0x40004004u)
#define UART_STATE_TX_FULL 1u
#define UART_STATE_RX_FULL 2u
#define UART_CONTROL REGISTER(0x40004008u)
#define UART_CONTROL_RUN 15u                 /* transmitter, receiver, and an interrupt for each */
#define UART_INTERRUPT REGISTER(0x4000400Cu) /* writing a bit clears it */
#define UART_INTERRUPT_TX 1u
#define UART_INTERRUPT_RX 2u
#define UART_DIVIDER REGISTER(0x40004010u)
#define UART_DIVIDER_1_MBAUD CLOCK_MHZ

#define UART_RX_VECTOR 0u /* interrupt numbers */
#define UART_TX_VECTOR 1u

/* What memory holds is not kept in registers across this. One processor and no cache: no instruction is needed. */
static inline void memory_barrier(void)
{
    __asm volatile("" ::: "memory");
}

#endif
