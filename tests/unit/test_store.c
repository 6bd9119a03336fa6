/* Two slots of emulated flash, whose power goes at any byte of any erase and program. */
#include "ecu/store.h"

#include "ecu/crc32.h"
#include "testing.h"

#define NEVER UINT32_MAX

enum erase_order { FROM_START, FROM_END, ALL_AT_ONCE, ERASE_ORDERS };

/* What flash does: erasing sets all bits of a slot, programming clears bits, and neither is done at once. */
static struct flash {
    uint8_t bytes[STORE_SLOTS][STORE_SLOT_BYTES];
    enum erase_order order;
    uint32_t steps;       /* bytes erased or programmed */
    uint32_t power_until; /* steps; the byte of the last one is left half done */
    bool misused;         /* a word programmed twice, or not a whole one */
    uint32_t stuck_at;    /* offset of a byte that keeps what it has, in each slot */
    bool read_fails[STORE_SLOTS];
    uint32_t reads; /* since new, and the one that fails */
    uint32_t read_that_fails;
    uint32_t read_that_lies; /* one bit of it is wrong */
    bool erase_fails;
} flash;

static struct parameter_image set[4]; /* sets to tell apart */
static struct parameter_image loaded; /* what the last load() gave */

static bool powered(void)
{
    return flash.steps < flash.power_until;
}

/* One byte on its way from `from` to `to`: with the power gone meanwhile only some of its bits arrive. */
static uint8_t step(uint8_t from, uint8_t to)
{
    if (!powered()) {
        return from;
    }
    flash.steps++;
    return powered() ? to : (uint8_t)((from & 0xA5u) | (to & 0x5Au));
}

static bool flash_read(void *context, uint8_t slot, uint32_t offset, uint8_t *bytes, uint32_t length)
{
    struct flash *const f = context;
    f->reads++;
    TEST_ASSERT_LESS_OR_EQUAL_UINT32(STORE_SLOT_BYTES, offset + length);
    memcpy(bytes, &f->bytes[slot][offset], length);
    bytes[length / 2u] ^= f->reads == f->read_that_lies ? 0x04u : 0u;
    return powered() && !f->read_fails[slot] && f->reads != f->read_that_fails;
}

static bool flash_erase(void *context, uint8_t slot)
{
    struct flash *const f = context;
    for (uint32_t k = 0; k < STORE_SLOT_BYTES; k++) {
        uint8_t *const byte = &f->bytes[slot][f->order == FROM_END ? STORE_SLOT_BYTES - 1u - k : k];
        if (f->order == ALL_AT_ONCE && powered() && f->steps + 1u < f->power_until) {
            f->steps++; /* weaker and weaker; not to be read before it ends */
        } else if (k != f->stuck_at) {
            *byte = step(*byte, 0xFF);
        }
    }
    if (f->order == ALL_AT_ONCE) {
        for (uint32_t k = 0; k < STORE_SLOT_BYTES; k++) {
            f->bytes[slot][k] |= powered() && k != f->stuck_at ? 0xFFu : (uint8_t)(0x11u * (k % 15u));
        }
    }
    return powered() && !f->erase_fails;
}

static bool flash_program(void *context, uint8_t slot, uint32_t offset, const uint8_t *bytes, uint32_t length)
{
    struct flash *const f = context;
    TEST_ASSERT_LESS_OR_EQUAL_UINT32(STORE_SLOT_BYTES, offset + length);
    f->misused = f->misused || offset % STORE_WORD_BYTES != 0u || length % STORE_WORD_BYTES != 0u;
    for (uint32_t k = 0; k < length; k++) {
        uint8_t *const byte = &f->bytes[slot][offset + k];
        f->misused = f->misused || (powered() && *byte != 0xFFu && offset + k != f->stuck_at);
        if (offset + k != f->stuck_at) {
            *byte = step(*byte, (uint8_t)(*byte & bytes[k]));
        }
    }
    return powered();
}

static const struct store_port PORT = {
    .context = &flash, .read = flash_read, .erase = flash_erase, .program = flash_program};

static void new_flash(void)
{
    flash = (struct flash){.power_until = NEVER, .stuck_at = NEVER};
    memset(flash.bytes, 0xFF, sizeof flash.bytes);
}

void setUp(void)
{
    new_flash();
    for (uint8_t k = 0; k < COUNT_OF(set); k++) {
        set[k] = default_parameter_image;
        image_set_u32(&set[k], IMAGE_HEADER_BYTES, image_u32(&set[k], IMAGE_HEADER_BYTES) + k + 1u);
        image_seal(&set[k]);
    }
}

void tearDown(void)
{
    TEST_ASSERT_FALSE_MESSAGE(flash.misused, "a word was programmed twice, or in part");
}

static enum store_status load(void)
{
    memset(&loaded, 0x77, sizeof loaded);
    return store_load(&PORT, &loaded);
}

static bool is_loaded(const struct parameter_image *image)
{
    return memcmp(&loaded, image, sizeof loaded) == 0;
}

static bool is_untouched(void)
{
    struct parameter_image untouched;
    memset(&untouched, 0x77, sizeof untouched);
    return is_loaded(&untouched);
}

static void save(uint8_t k)
{
    TEST_ASSERT_EQUAL_INT(STORE_OK, store_save(&PORT, &set[k]));
}

static void expect(enum store_status status, uint8_t k)
{
    TEST_ASSERT_EQUAL_INT(status, load());
    TEST_ASSERT_TRUE(is_loaded(&set[k]));
}

/* A whole header as this project writes it, by the test's own knowledge of the layout. */
static void put_header(uint8_t slot, const char kind[4], uint32_t layout, uint32_t sequence)
{
    struct parameter_image words = {0}; /* only to have image_set_u32 */
    memcpy(&words.bytes[0], "DSET", 4);
    memcpy(&words.bytes[4], kind, 4);
    image_set_u32(&words, 8, layout);
    image_set_u32(&words, 12, sequence);
    image_set_u32(&words, 16, crc32_add(CRC32_START, &flash.bytes[slot][24], PARAMETER_IMAGE_BYTES));
    image_set_u32(&words, 20, crc32_add(CRC32_START, words.bytes, 20));
    memcpy(flash.bytes[slot], words.bytes, 24);
}

/* ---- what is saved is found ---- */

static void test_crc_is_not_the_standard_one(void)
{
    /* GIVEN the check value of CRC-32 WHEN taken whole and in pieces THEN it is that of the standard */
    const uint8_t *const digits = (const uint8_t *)"123456789";
    TEST_ASSERT_EQUAL_HEX32(0xCBF43926u, crc32_add(CRC32_START, digits, 9));
    TEST_ASSERT_EQUAL_HEX32(0xCBF43926u, crc32_add(crc32_add(CRC32_START, digits, 4), &digits[4], 5));
}

static void test_blank_flash_taken_for_damage(void)
{
    /* GIVEN a new chip WHEN loaded THEN empty, and the image is left alone */
    TEST_ASSERT_EQUAL_INT(STORE_EMPTY, load());
    TEST_ASSERT_TRUE(is_untouched());
}

static void test_saved_set_not_found_again(void)
{
    /* GIVEN sets saved one after another WHEN loaded THEN each time the last one, and both slots are in use */
    for (uint8_t k = 0; k < 9; k++) {
        save(k % 4u);
        expect(STORE_OK, k % 4u);
    }
    TEST_ASSERT_EQUAL_MEMORY(set[0].bytes, &flash.bytes[0][24], PARAMETER_IMAGE_BYTES);
    TEST_ASSERT_EQUAL_MEMORY(set[3].bytes, &flash.bytes[1][24], PARAMETER_IMAGE_BYTES);
}

static void test_sequence_that_goes_round_finds_the_older_set(void)
{
    /* GIVEN a sequence just below its end WHEN saved across it THEN always the last one is loaded */
    memcpy(&flash.bytes[0][24], set[0].bytes, PARAMETER_IMAGE_BYTES);
    put_header(0, "IMAG", PARAMETER_LAYOUT_HASH, UINT32_MAX - 2u);
    expect(STORE_OK, 0);
    for (uint8_t k = 1; k < 9; k++) {
        save(k % 4u);
        expect(STORE_OK, k % 4u);
    }
    TEST_ASSERT_EQUAL_HEX32(5, flash.bytes[0][12] | (uint32_t)flash.bytes[0][13] << 8);
}

static void test_default_not_restored(void)
{
    /* GIVEN sets WHEN the default is restored THEN nothing is loaded any more, and it is no error; a set that
     * is saved afterwards is */
    save(0);
    save(1);
    TEST_ASSERT_EQUAL_INT(STORE_OK, store_restore_default(&PORT));
    TEST_ASSERT_EQUAL_INT(STORE_EMPTY, load());
    TEST_ASSERT_TRUE(is_untouched());
    TEST_ASSERT_EQUAL_INT(STORE_OK, store_restore_default(&PORT));
    TEST_ASSERT_EQUAL_INT(STORE_EMPTY, load());
    save(2);
    expect(STORE_OK, 2);
}

static void test_set_of_other_firmware_taken(void)
{
    /* GIVEN the newest set of firmware with another list of parameters THEN it is not taken, nor the older one in
     * silence; saving makes it good */
    save(0);
    put_header(1, "IMAG", PARAMETER_LAYOUT_HASH + 1u, 2);
    TEST_ASSERT_EQUAL_INT(STORE_FOREIGN, load());
    TEST_ASSERT_TRUE(is_untouched());
    put_header(1, "ELSE", PARAMETER_LAYOUT_HASH, 2);
    TEST_ASSERT_EQUAL_INT(STORE_FOREIGN, load());
    save(1);
    expect(STORE_OK, 1);
}

/* ---- power goes ---- */

/* From `before`, save `next` (or restore the default, next NULL) with the power cut after n steps; then look. Returns
 * whether the power lasted. */
static bool cut(const struct flash *before, uint32_t n, const struct parameter_image *old,
                const struct parameter_image *next)
{
    flash = *before;
    flash.steps = 0;
    flash.power_until = n;
    const enum store_status said = next != NULL ? store_save(&PORT, next) : store_restore_default(&PORT);
    const bool lasted = powered();
    TEST_ASSERT_EQUAL_INT(lasted ? STORE_OK : STORE_FAILED, said);
    flash.power_until = NEVER;
    const enum store_status found = load();
    const bool is_new = next != NULL ? (found == STORE_OK && is_loaded(next)) : found == STORE_EMPTY;
    bool is_old = (found == STORE_OK || found == STORE_OLDER) && old != NULL && is_loaded(old);
    if (old == NULL) { /* the default; a header cut in its last word is reported */
        is_old = (found == STORE_EMPTY || found == STORE_DAMAGED) && is_untouched();
    }
    TEST_ASSERT_TRUE(lasted ? is_new : is_new || is_old);
    return lasted;
}

static void cut_everywhere(const struct parameter_image *old, const struct parameter_image *next)
{
    const struct flash before = flash;
    uint32_t n = 1;
    uint32_t olds = 0;
    while (!cut(&before, n, old, next)) {
        olds++;
        if (n % 16u == 1u) { /* and once more, while what was broken off is made good */
            const struct flash broken = flash;
            for (uint32_t m = 1; !cut(&broken, m, old, &set[2]); m += 41u) {
            }
        }
        save(3); /* whatever was left: the next save is good, and nothing is reported after it */
        expect(STORE_OK, 3);
        n++;
    }
    /* every byte of the erase, the body and the header was tried */
    TEST_ASSERT_EQUAL_UINT32(STORE_SLOT_BYTES + STORE_HEADER_BYTES + (next != NULL ? STORE_BODY_BYTES : 0u),
                             olds);
    flash = before;
}

static void test_power_cut_loses_both_sets(void)
{
    /* GIVEN one or two sets WHEN the power goes at any byte of a save, whichever way the chip erases THEN the old
     * or the new set is found, whole */
    for (enum erase_order order = FROM_START; order < ERASE_ORDERS; order++) {
        new_flash();
        flash.order = order;
        save(0);
        cut_everywhere(&set[0], &set[1]);
        save(1);
        cut_everywhere(&set[1], &set[0]);
        save(2);
        cut_everywhere(&set[2], &set[0]);
    }
}

static void test_power_cut_in_the_first_save_makes_up_a_set(void)
{
    /* GIVEN a new chip WHEN the power goes at any byte of its first save THEN the default or the new set */
    cut_everywhere(NULL, &set[1]);
}

static void test_power_cut_while_restoring_loses_the_set(void)
{
    /* GIVEN sets WHEN the power goes at any byte of restoring the default THEN the old set or the default */
    for (enum erase_order order = FROM_START; order < ERASE_ORDERS; order++) {
        new_flash();
        flash.order = order;
        save(0);
        cut_everywhere(&set[0], NULL);
        save(1);
        cut_everywhere(&set[1], NULL);
        TEST_ASSERT_EQUAL_INT(STORE_OK, store_restore_default(&PORT));
        cut_everywhere(NULL, &set[2]);
    }
}

/* ---- flash that forgets or wears out ---- */

static void test_damage_not_noticed(void)
{
    /* GIVEN two sets WHEN any bit of the newest slot is wrong THEN the older set is used, and it is said */
    save(0);
    save(1);
    for (uint32_t k = 0; k < STORE_HEADER_BYTES + PARAMETER_IMAGE_BYTES; k++) {
        for (uint8_t bit = 0; bit < 8u; bit++) {
            flash.bytes[1][k] ^= (uint8_t)(1u << bit);
            expect(STORE_OLDER, 0);
            flash.bytes[1][k] ^= (uint8_t)(1u << bit);
        }
    }
    expect(STORE_OK, 1);
}

static void test_damage_of_the_older_set_hides_the_newest(void)
{
    /* GIVEN two sets WHEN any byte of the older slot is wrong THEN the newest is used; it is said only when the
     * header is gone, for then nobody can tell that it was the older */
    save(0);
    save(1);
    for (uint32_t k = 0; k < STORE_HEADER_BYTES + PARAMETER_IMAGE_BYTES; k++) {
        flash.bytes[0][k] ^= 0x10u;
        expect(k < STORE_HEADER_BYTES ? STORE_OLDER : STORE_OK, 1);
        flash.bytes[0][k] ^= 0x10u;
    }
}

static void test_damage_with_nothing_left_taken_for_a_new_chip(void)
{
    /* GIVEN one set WHEN any byte of it is wrong, or both of two are THEN damaged, the image left alone; a save
     * makes it good */
    save(0);
    const struct flash one = flash;
    for (uint32_t k = 0; k < STORE_HEADER_BYTES + PARAMETER_IMAGE_BYTES; k++) {
        flash.bytes[0][k] ^= 0x01u;
        TEST_ASSERT_EQUAL_INT(STORE_DAMAGED, load());
        TEST_ASSERT_TRUE(is_untouched());
        flash = one;
    }
    save(1);
    for (uint32_t header = 0; header < 2u; header++) {
        flash.bytes[0][header == 0u ? 30 : 3] ^= 0x01u;
        flash.bytes[1][header == 0u ? 30 : 3] ^= 0x01u;
        TEST_ASSERT_EQUAL_INT(STORE_DAMAGED, load());
        save(2);
        expect(STORE_OK, 2);
        save(1);
        expect(STORE_OK, 1);
    }
}

static void test_damage_beside_the_restored_default_not_told(void)
{
    /* GIVEN the default restored WHEN the slot that says so is damaged THEN the set before it is not taken in
     * silence; and with the other slot's header gone it is said, too */
    save(0);
    TEST_ASSERT_EQUAL_INT(STORE_OK, store_restore_default(&PORT));
    flash.bytes[1][2] ^= 0x08u;
    expect(STORE_OLDER, 0);
    flash.bytes[1][2] ^= 0x08u;
    flash.bytes[0][2] ^= 0x08u;
    TEST_ASSERT_EQUAL_INT(STORE_DAMAGED, load());
}

static void test_worn_out_byte_not_noticed(void)
{
    /* GIVEN a byte that cannot be programmed, or not be erased, anywhere in a slot WHEN saved THEN failed, and the
     * set before is still there and good */
    for (uint32_t k = 0; k < STORE_SLOT_BYTES; k++) {
        for (uint8_t stuck = 0; stuck < 2u; stuck++) {
            new_flash();
            save(0);
            flash.stuck_at = k;
            flash.bytes[1][k] = stuck == 0u ? 0xFF : 0x00;
            const enum store_status said = store_save(&PORT, &set[1]);
            const bool happens_to_fit = said == STORE_OK;
            if (happens_to_fit) { /* the byte that is stuck is the one that was wanted */
                const uint8_t found = flash.bytes[1][k];
                TEST_ASSERT_EQUAL_HEX8(stuck == 0u ? 0xFF : 0x00, found);
                expect(STORE_OK, 1);
            } else {
                TEST_ASSERT_EQUAL_INT(STORE_FAILED, said);
                const enum store_status found = load();
                TEST_ASSERT_TRUE(found == STORE_OK || found == STORE_OLDER);
                TEST_ASSERT_TRUE(is_loaded(&set[0]));
            }
        }
    }
}

static void test_memory_that_fails_not_told(void)
{
    /* GIVEN a slot that cannot be read THEN it is a damaged one; none at all: damaged, and a save fails */
    save(0);
    save(1);
    flash.read_fails[1] = true;
    expect(STORE_OLDER, 0);
    TEST_ASSERT_EQUAL_INT(STORE_FAILED, store_save(&PORT, &set[2]));
    expect(STORE_OLDER, 0);
    flash.read_fails[0] = true;
    TEST_ASSERT_EQUAL_INT(STORE_DAMAGED, load());
    TEST_ASSERT_EQUAL_INT(STORE_FAILED, store_save(&PORT, &set[2]));

    new_flash();
    save(0);
    flash.erase_fails = true;
    TEST_ASSERT_EQUAL_INT(STORE_FAILED, store_save(&PORT, &set[1]));
    TEST_ASSERT_EQUAL_INT(STORE_FAILED, store_restore_default(&PORT));
    expect(STORE_OK, 0);
}

static void test_save_that_failed_counts_all_the_same(void)
{
    /* GIVEN two sets WHEN any one read of a save fails THEN the save fails and the newest set is still the newest,
     * or the slot that could not be looked at is taken for damaged and the new set is saved */
    uint32_t failed = 0;
    bool reached = true;
    for (uint32_t n = 1; reached; n++) {
        new_flash();
        save(0);
        save(1);
        flash.reads = 0;
        flash.read_that_fails = n;
        const enum store_status said = store_save(&PORT, &set[2]);
        reached = flash.reads >= n;
        flash.read_that_fails = 0;
        failed += said == STORE_FAILED ? 1u : 0u;
        expect(STORE_OK, said == STORE_FAILED ? 1 : 2);
    }
    TEST_ASSERT_GREATER_OR_EQUAL_UINT32(STORE_BODY_BYTES / 32u + 2u, failed);
}

static void test_set_that_reads_otherwise_the_second_time_is_used(void)
{
    /* GIVEN two sets WHEN any one read of a load fails, or one bit of it is wrong THEN never an image that is none of
     * the two, and never the older one in silence: it is the newest, or the load says what happened */
    for (uint8_t lies = 0; lies < 2u; lies++) {
        uint32_t failed = 0;
        bool reached = true;
        save(0);
        save(1);
        for (uint32_t n = 1; reached; n++) {
            flash.reads = 0;
            flash.read_that_fails = lies == 0u ? n : 0u;
            flash.read_that_lies = lies == 0u ? 0u : n;
            const enum store_status said = load();
            reached = flash.reads >= n;
            failed += said == STORE_FAILED ? 1u : 0u;
            if (said == STORE_OLDER) {
                TEST_ASSERT_TRUE(is_loaded(&set[0]) || is_loaded(&set[1])); /* the slot that was doubtful */
            } else if (said != STORE_FAILED) {
                TEST_ASSERT_EQUAL_INT(STORE_OK, said);
                TEST_ASSERT_TRUE(is_loaded(&set[1]));
            }
        }
        TEST_ASSERT_EQUAL_UINT32((PARAMETER_IMAGE_BYTES + 31u) / 32u, failed); /* each chunk's second read */
        new_flash();
    }
}

static void test_damage_that_cannot_be_erased_kept_beside_a_new_set(void)
{
    /* GIVEN both sets damaged and a memory that does not erase any more WHEN saved THEN failed and nothing promised:
     * with the slot left as it is, the new set would be reported as the older one for ever */
    save(0);
    save(1);
    flash.bytes[0][30] ^= 0x01u;
    flash.bytes[1][30] ^= 0x01u;
    const struct flash before = flash;
    flash.erase_fails = true;
    flash.stuck_at = 0; /* nor is the header gone by chance */
    TEST_ASSERT_EQUAL_INT(STORE_FAILED, store_save(&PORT, &set[2]));
    TEST_ASSERT_EQUAL_MEMORY(before.bytes[0], flash.bytes[0], STORE_SLOT_BYTES); /* not begun */
    flash.erase_fails = false;
    flash.stuck_at = NEVER;
    save(2);
    expect(STORE_OK, 2);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_crc_is_not_the_standard_one);
    RUN_TEST(test_blank_flash_taken_for_damage);
    RUN_TEST(test_saved_set_not_found_again);
    RUN_TEST(test_sequence_that_goes_round_finds_the_older_set);
    RUN_TEST(test_default_not_restored);
    RUN_TEST(test_set_of_other_firmware_taken);
    RUN_TEST(test_power_cut_loses_both_sets);
    RUN_TEST(test_power_cut_in_the_first_save_makes_up_a_set);
    RUN_TEST(test_power_cut_while_restoring_loses_the_set);
    RUN_TEST(test_damage_not_noticed);
    RUN_TEST(test_damage_of_the_older_set_hides_the_newest);
    RUN_TEST(test_damage_with_nothing_left_taken_for_a_new_chip);
    RUN_TEST(test_damage_beside_the_restored_default_not_told);
    RUN_TEST(test_worn_out_byte_not_noticed);
    RUN_TEST(test_memory_that_fails_not_told);
    RUN_TEST(test_save_that_failed_counts_all_the_same);
    RUN_TEST(test_set_that_reads_otherwise_the_second_time_is_used);
    RUN_TEST(test_damage_that_cannot_be_erased_kept_beside_a_new_set);
    return UNITY_END();
}
