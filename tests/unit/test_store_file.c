/* The store in a file (ports/linux/store_file), on a real file system. */
#define _GNU_SOURCE
#include "ports/linux/store_file.h"

#include <fcntl.h>
#include <stdlib.h>
#include <sys/stat.h>
#include <unistd.h>

#include "testing.h"

static char folder[] = "/tmp/diarc_store_XXXXXX";
static char path[64];
static struct store_file file, second;
static struct parameter_image set, loaded;

void setUp(void)
{
    memcpy(folder, "/tmp/diarc_store_XXXXXX", sizeof folder);
    TEST_ASSERT_NOT_NULL(mkdtemp(folder));
    (void)snprintf(path, sizeof path, "%s/store", folder);
    set = default_parameter_image;
    image_set_u32(&set, IMAGE_HEADER_BYTES, 0x41000000u);
    image_seal(&set);
}

void tearDown(void)
{
    (void)unlink(path);
    (void)rmdir(folder);
}

static void open_store(void)
{
    TEST_ASSERT_TRUE_MESSAGE(store_file_open(&file, path), file.message);
}

static void put_file(const char *bytes, size_t length)
{
    const int fd = open(path, O_WRONLY | O_CREAT | O_TRUNC, 0600);
    TEST_ASSERT_TRUE(fd >= 0);
    TEST_ASSERT_EQUAL_INT64((int64_t)length, write(fd, bytes, length));
    (void)close(fd);
}

static void test_set_gone_with_the_process(void)
{
    /* GIVEN sets saved WHEN the file is closed and opened again THEN the last one is there; and the default, once
     * restored */
    open_store();
    TEST_ASSERT_EQUAL_INT(STORE_EMPTY, store_load(&file.port, &loaded));
    for (int k = 0; k < 3; k++) {
        image_set_u32(&set, IMAGE_HEADER_BYTES, 0x41000000u + (uint32_t)k);
        TEST_ASSERT_EQUAL_INT(STORE_OK, store_save(&file.port, &set));
        store_file_close(&file);
        open_store();
        TEST_ASSERT_EQUAL_INT(STORE_OK, store_load(&file.port, &loaded));
        TEST_ASSERT_EQUAL_MEMORY(&set, &loaded, sizeof set);
    }
    TEST_ASSERT_EQUAL_INT(STORE_OK, store_restore_default(&file.port));
    store_file_close(&file);
    open_store();
    TEST_ASSERT_EQUAL_INT(STORE_EMPTY, store_load(&file.port, &loaded));
    store_file_close(&file);
}

static void test_file_of_two_ecus(void)
{
    /* GIVEN a store in use WHEN another opens it THEN refused with the reason; afterwards it may */
    open_store();
    TEST_ASSERT_FALSE(store_file_open(&second, path));
    TEST_ASSERT_NOT_NULL(strstr(second.message, "another process has it"));
    TEST_ASSERT_EQUAL_INT(STORE_OK, store_save(&file.port, &set));
    store_file_close(&file);
    TEST_ASSERT_TRUE(store_file_open(&second, path));
    store_file_close(&second);
}

static void test_file_that_anyone_may_write(void)
{
    /* GIVEN any umask WHEN the file is made THEN only its owner may read and write it */
    const mode_t before = umask(0);
    open_store();
    (void)umask(before);
    struct stat status;
    TEST_ASSERT_EQUAL_INT(0, stat(path, &status));
    TEST_ASSERT_EQUAL_HEX32(0600, status.st_mode & 0777u);
    store_file_close(&file);
}

static void test_somebody_elses_file_overwritten(void)
{
    /* GIVEN a file that is no store WHEN opened THEN refused, and not a byte of it is changed */
    static const char *const contents[] = {"x", "DIARC store 2\nand more than that", "load_mass_kg = 2.5\n"};
    for (size_t k = 0; k < COUNT_OF(contents); k++) {
        char found[64] = {0};
        put_file(contents[k], strlen(contents[k]));
        TEST_ASSERT_FALSE(store_file_open(&file, path));
        TEST_ASSERT_NOT_NULL(strstr(file.message, "no parameter store"));
        const int fd = open(path, O_RDONLY);
        TEST_ASSERT_EQUAL_INT64((int64_t)strlen(contents[k]), read(fd, found, sizeof found));
        (void)close(fd);
        TEST_ASSERT_EQUAL_STRING(contents[k], found);
    }
}

static void test_pipe_or_folder_waited_for(void)
{
    /* GIVEN a pipe by that name, or no folder WHEN opened THEN refused at once, with what to do */
    TEST_ASSERT_EQUAL_INT(0, mkfifo(path, 0600));
    TEST_ASSERT_FALSE(store_file_open(&file, path));
    TEST_ASSERT_NOT_NULL(strstr(file.message, "no ordinary file"));
    TEST_ASSERT_FALSE(store_file_open(&file, folder));
    TEST_ASSERT_NOT_NULL(strstr(file.message, "read and write"));
    TEST_ASSERT_FALSE(store_file_open(&file, "/nowhere/at/all"));
    TEST_ASSERT_NOT_NULL(strstr(file.message, "No such file"));
}

static void test_file_cut_short_taken_for_a_set(void)
{
    /* GIVEN two sets WHEN the file is cut at any length THEN never a set that was not saved */
    open_store();
    struct parameter_image older = set;
    image_set_u32(&older, IMAGE_HEADER_BYTES, 0x41000001u);
    TEST_ASSERT_EQUAL_INT(STORE_OK, store_save(&file.port, &older));
    TEST_ASSERT_EQUAL_INT(STORE_OK, store_save(&file.port, &set));
    const off_t whole = lseek(file.fd, 0, SEEK_END);
    for (off_t length = whole; length > 16; length -= length > whole - 600 ? 7 : 1999) {
        TEST_ASSERT_EQUAL_INT(0, ftruncate(file.fd, length));
        const enum store_status status = store_load(&file.port, &loaded);
        const bool is_one =
            memcmp(&loaded, &set, sizeof set) == 0 || memcmp(&loaded, &older, sizeof set) == 0;
        TEST_ASSERT_TRUE(status == STORE_EMPTY || status == STORE_DAMAGED || is_one);
        TEST_ASSERT_TRUE(length == whole || memcmp(&loaded, &set, sizeof set) != 0 || status != STORE_OK);
    }
    store_file_close(&file);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_set_gone_with_the_process);
    RUN_TEST(test_file_of_two_ecus);
    RUN_TEST(test_file_that_anyone_may_write);
    RUN_TEST(test_somebody_elses_file_overwritten);
    RUN_TEST(test_pipe_or_folder_waited_for);
    RUN_TEST(test_file_cut_short_taken_for_a_set);
    return UNITY_END();
}
