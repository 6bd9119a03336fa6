#define _GNU_SOURCE
#include "ports/linux/bus.h"

#include <string.h>
#include <sys/socket.h>
#include <time.h>

#include "ports/linux/clock.h"

uint32_t bus_now_us(void *context)
{
    const struct bus *const bus = context;
    return (uint32_t)((bus->came_ns != 0 ? bus->came_ns : clock_of_frames_ns()) / NS_PER_US);
}

int64_t bus_message_time_ns(struct msghdr *header)
{
    for (struct cmsghdr *part = CMSG_FIRSTHDR(header); part != NULL; part = CMSG_NXTHDR(header, part)) {
        if (part->cmsg_level == SOL_SOCKET && part->cmsg_type == SCM_TIMESTAMPNS) {
            struct timespec time;
            memcpy(&time, CMSG_DATA(part), sizeof time);
            return (int64_t)time.tv_sec * NS_PER_S + time.tv_nsec;
        }
    }
    return clock_of_frames_ns();
}
