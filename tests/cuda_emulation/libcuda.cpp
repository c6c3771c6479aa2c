// libcuda on a CPU, for tests: contexts, modules and launches, with the checks that the real driver makes. A module is a
// library that the libnvrtc beside this made with g++, alone or behind a line of PTX; a launch runs it at once.
#include <dlfcn.h>
#include <elf.h>
#include <sys/mman.h>
#include <unistd.h>

#include <cstring>
#include <map>
#include <mutex>
#include <string>
#include <vector>

typedef int Result;
enum { SUCCESS = 0, INVALID_VALUE = 1, INVALID_IMAGE = 200, INVALID_CONTEXT = 201, UNSUPPORTED_PTX = 222,
       INVALID_HANDLE = 400, NOT_FOUND = 500, OUT_OF_RESOURCES = 701, CAPTURE_UNSUPPORTED = 900 };
enum { DEVICES = 8, THREADS = 256, RELAXED = 2 };

struct Context { int device; Result fault; };
struct Module { Context* context; void* library; };
struct Function { Module* module; void (*run)(long long, const void*, int); size_t task; };
struct Failure { Result code; int times; };

static Context contexts[DEVICES];
static std::mutex lock;
static std::map<std::string, Failure> failures;
static std::map<std::string, long long> calls;
static int reversed = 0, dry = 0, capturing = 0, capture_valid = 1;
static thread_local Context* current = nullptr;
static thread_local int capture_mode = 0;

static bool is_sticky(Result code) { return code == 700 || code == 719; }

// What every call does first: it is counted, fails where a test said so, and after a fault always.
static Result enter(const char* name) {
    std::lock_guard<std::mutex> guard(lock);
    ++calls[name];
    if (current && current->fault) return current->fault;
    Failure& failure = failures[name];
    if (failure.times > 0) {
        --failure.times;
        if (current && is_sticky(failure.code)) current->fault = failure.code;
        return failure.code;
    }
    return SUCCESS;
}

extern "C" {

Result cuDevicePrimaryCtxRetain(Context** context, int device) {
    if (Result code = enter("cuDevicePrimaryCtxRetain")) return code;
    if (device < 0 || device >= DEVICES) return 101;
    contexts[device].device = device;
    *context = &contexts[device];
    return SUCCESS;
}

Result cuCtxGetCurrent(Context** context) { *context = current; return enter("cuCtxGetCurrent"); }

Result cuCtxSetCurrent(Context* context) {
    current = context;
    ++calls["cuCtxSetCurrent"];
    return SUCCESS;
}

Result cuThreadExchangeStreamCaptureMode(int* mode) {
    std::swap(*mode, capture_mode);
    return enter("cuThreadExchangeStreamCaptureMode");
}

Result cuModuleLoadData(Module** module, const char* image) {
    if (Result code = enter("cuModuleLoadData")) return code;
    if (!current) return INVALID_CONTEXT;
    if (capturing && capture_mode != RELAXED) { capture_valid = 0; return CAPTURE_UNSUPPORTED; }
    const char ptx[] = ".version 8.8\n";
    if (!std::strncmp(image, ptx, sizeof ptx - 1)) image += sizeof ptx - 1;
    if (std::memcmp(image, ELFMAG, SELFMAG)) return INVALID_IMAGE;
    Elf64_Ehdr header;
    std::memcpy(&header, image, sizeof header);
    const size_t size = header.e_shoff + (size_t)header.e_shnum * header.e_shentsize;  // the last of a library
    const int file = memfd_create("module", 0);
    for (size_t done = 0; done < size;) {
        const ssize_t written = write(file, image + done, size - done);
        if (written <= 0) return 2;
        done += (size_t)written;
    }
    // The file stays open: a second library of the same name would be taken for the first.
    void* library = dlopen(("/proc/self/fd/" + std::to_string(file)).c_str(), RTLD_NOW | RTLD_LOCAL);
    if (!library) return INVALID_IMAGE;
    *module = new Module{current, library};
    return SUCCESS;
}

Result cuModuleGetFunction(Function** function, Module* module, const char* name) {
    if (Result code = enter("cuModuleGetFunction")) return code;
    if (module->context != current) return INVALID_CONTEXT;
    void* run = dlsym(module->library, name);
    if (!run) return NOT_FOUND;
    unsigned long long (*size_of_task)() = (unsigned long long (*)())dlsym(module->library, "size_of_task");
    *function = new Function{module, (void (*)(long long, const void*, int))run, (size_t)size_of_task()};
    return SUCCESS;
}

Result cuLaunchKernel(Function* function, unsigned x, unsigned y, unsigned z, unsigned threads, unsigned threads_y,
                      unsigned threads_z, unsigned shared, void*, void** arguments, void** extra) {
    if (Result code = enter("cuLaunchKernel")) return code;
    if (!current) return INVALID_CONTEXT;
    if (function->module->context != current) return INVALID_HANDLE;
    if (x < 1 || x > 0x7fffffffu || y != 1 || z != 1 || threads_y != 1 || threads_z != 1 || shared || extra)
        return INVALID_VALUE;
    if (threads != THREADS) return OUT_OF_RESOURCES;  // __launch_bounds__
    if (dry) return SUCCESS;
    std::vector<char> task(function->task);  // the argument is copied at once
    std::memcpy(task.data(), arguments[0], task.size());
    function->run(x, task.data(), reversed);
    return SUCCESS;
}

Result cuGetErrorString(int code, const char** text) {
    static const std::map<int, const char*> texts = {
        {2, "out of memory"}, {200, "device kernel image is invalid"}, {209, "no kernel image is available"},
        {222, "the provided PTX was compiled with an unsupported toolchain."},
        {700, "an illegal memory access was encountered"}, {719, "unspecified launch failure"}};
    const auto found = texts.find(code);
    *text = found == texts.end() ? nullptr : found->second;
    return found == texts.end() ? INVALID_VALUE : SUCCESS;
}

// ---- for tests -----------------------------------------------------------------------------------------------------

void test_reset() {
    std::lock_guard<std::mutex> guard(lock);
    failures.clear();
    calls.clear();
    reversed = dry = capturing = 0;
    capture_valid = 1;
    for (Context& context : contexts) context.fault = SUCCESS;
}
void test_fail(const char* name, int code, int times) { failures[name] = Failure{code, times}; }
long long test_calls(const char* name) { return calls[name]; }
void test_reverse(int on) { reversed = on; }
void test_dry(int on) { dry = on; }
void test_capture(int on) { capturing = on; capture_valid = 1; }
int test_capture_is_valid() { return capture_valid; }
int test_current_device() { return current ? current->device : -1; }
}
