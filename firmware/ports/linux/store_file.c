#define _GNU_SOURCE
#include "ports/linux/store_file.h"

#include <errno.h>
#include <fcntl.h>
#include <libgen.h>
#include <limits.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

/* What the file begins with; the slots follow, far enough apart that no block of a disk holds parts of both. */
static const char mark[16] = "DIARC store 1\n";
enum { SLOT_STRIDE_BYTES = 65536 };

_Static_assert(STORE_SLOT_BYTES <= SLOT_STRIDE_BYTES, "slots do not overlap");

__attribute__((format(printf, 2, 3))) static bool complain(struct store_file *file, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    (void)vsnprintf(file->message, sizeof file->message, format, arguments);
    va_end(arguments);
    if (file->fd >= 0) {
        (void)close(file->fd);
        file->fd = -1;
    }
    return false;
}

static off_t place(uint8_t slot, uint32_t offset)
{
    return (off_t)SLOT_STRIDE_BYTES * (slot + 1) + (off_t)offset;
}

/* All bytes, however many calls it takes; `got` fewer only at the end of the file. */
static bool read_all(int fd, void *bytes, size_t length, off_t at, size_t *got)
{
    *got = 0;
    while (*got < length) {
        const ssize_t count = pread(fd, (char *)bytes + *got, length - *got, at + (off_t)*got);
        if (count == 0) {
            return true;
        }
        if (count < 0 && errno != EINTR) {
            return false;
        }
        *got += count > 0 ? (size_t)count : 0;
    }
    return true;
}

static bool write_all(int fd, const void *bytes, size_t length, off_t at)
{
    size_t done = 0;
    while (done < length) {
        const ssize_t count = pwrite(fd, (const char *)bytes + done, length - done, at + (off_t)done);
        if (count < 0 && errno != EINTR) {
            return false;
        }
        done += count > 0 ? (size_t)count : 0;
    }
    return true;
}

/* What lies beyond the file's end was never programmed. */
static bool port_read(void *context, uint8_t slot, uint32_t offset, uint8_t *bytes, uint32_t length)
{
    const struct store_file *const file = context;
    size_t got;
    if (!read_all(file->fd, bytes, length, place(slot, offset), &got)) {
        return false;
    }
    memset(bytes + got, 0xFF, length - got);
    return true;
}

static bool port_erase(void *context, uint8_t slot)
{
    const struct store_file *const file = context;
    uint8_t erased[STORE_SLOT_BYTES];
    memset(erased, 0xFF, sizeof erased);
    return write_all(file->fd, erased, sizeof erased, place(slot, 0)) && fdatasync(file->fd) == 0;
}

/* The body may reach the disk in any order; but it is there before the header begins, and the header before this
 * returns. */
static bool port_program(void *context, uint8_t slot, uint32_t offset, const uint8_t *bytes, uint32_t length)
{
    const struct store_file *const file = context;
    const bool is_header = offset < STORE_HEADER_BYTES;
    return (!is_header || fdatasync(file->fd) == 0) &&
           write_all(file->fd, bytes, length, place(slot, offset)) &&
           (!is_header || fdatasync(file->fd) == 0);
}

/* A new file's name must survive, too. */
static bool sync_folder(const char *path)
{
    char copy[PATH_MAX];
    if (strlen(path) >= sizeof copy) {
        errno = ENAMETOOLONG;
        return false;
    }
    memcpy(copy, path, strlen(path) + 1);
    const int folder = open(dirname(copy), O_RDONLY | O_DIRECTORY | O_CLOEXEC);
    if (folder < 0) {
        return false;
    }
    const bool synced = fsync(folder) == 0;
    (void)close(folder);
    return synced;
}

bool store_file_open(struct store_file *file, const char *path)
{
    *file = (struct store_file){
        .port = {.context = file, .read = port_read, .erase = port_erase, .program = port_program}};
    /* not blocking: a pipe by this name is refused below, not waited for */
    file->fd = open(path, O_RDWR | O_CREAT | O_CLOEXEC | O_NONBLOCK | O_NOCTTY, S_IRUSR | S_IWUSR);
    if (file->fd < 0) {
        return complain(file, "--store %s: %s; name a file that this user may read and write", path,
                        strerror(errno));
    }
    struct stat status;
    if (fstat(file->fd, &status) != 0 || !S_ISREG(status.st_mode)) {
        return complain(file, "--store %s: is no ordinary file; name one, or one to be made", path);
    }
    if (flock(file->fd, LOCK_EX | LOCK_NB) != 0) {
        if (errno == EWOULDBLOCK) {
            return complain(file, "--store %s: another process has it; each ECU needs a file of its own",
                            path);
        }
        return complain(file, "--store %s: cannot be locked: %s; name a file on a local disk", path,
                        strerror(errno));
    }
    char found[sizeof mark];
    size_t got;
    if (!read_all(file->fd, found, sizeof found, 0, &got)) {
        return complain(file, "--store %s: %s", path, strerror(errno));
    }
    if (got == sizeof mark && memcmp(found, mark, sizeof mark) == 0) {
        return true;
    }
    if (got > 0) {
        return complain(file, "--store %s: holds something that is no parameter store; name another file",
                        path);
    }
    if (!write_all(file->fd, mark, sizeof mark, 0) || fsync(file->fd) != 0 || !sync_folder(path)) {
        return complain(file, "--store %s: %s; name a file on a disk with room", path, strerror(errno));
    }
    return true;
}

void store_file_close(struct store_file *file)
{
    (void)close(file->fd);
    file->fd = -1;
}
