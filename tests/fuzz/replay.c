/* Runs a harness over files, for compilers without libFuzzer and for every number type: what was found once must
 * not come back. Arguments: files and folders of inputs. */
#include <dirent.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t length);

static unsigned inputs;

static int run_file(const char *path)
{
    static uint8_t bytes[1 << 16];
    FILE *const file = fopen(path, "rb");
    if (file == NULL) {
        (void)fprintf(stderr, "%s: cannot be read\n", path);
        return 1;
    }
    const size_t length = fread(bytes, 1, sizeof bytes, file);
    (void)fclose(file);
    (void)fprintf(stderr, "%s\n", path); /* the last line before an abort names the input */
    inputs++;
    return LLVMFuzzerTestOneInput(bytes, length);
}

static int run(const char *path)
{
    DIR *const folder = opendir(path);
    if (folder == NULL) {
        return run_file(path);
    }
    int status = 0;
    for (const struct dirent *entry = readdir(folder); entry != NULL && status == 0;
         entry = readdir(folder)) {
        char file[4096];
        const int length = snprintf(file, sizeof file, "%s/%s", path, entry->d_name);
        if (entry->d_name[0] != '.') {
            status = length < (int)sizeof file ? run_file(file) : 1;
        }
    }
    (void)closedir(folder);
    return status;
}

int main(int argc, char *argv[])
{
    int status = 0;
    for (int k = 1; k < argc && status == 0; k++) {
        status = run(argv[k]);
    }
    (void)printf("%u inputs\n", inputs);
    return status != 0 || inputs == 0u ? 1 : 0;
}
